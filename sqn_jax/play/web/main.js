import { MAP_KINDS } from './generate.js';
import { QBars, byId, drawHidden, drawRewards, drawSkills, fillRow, skillKey } from './panels.js';
import { Manual, listenToCross, listenToKeys, listenToPad, listenToPointer } from './controls.js';
import { fileName, fromHash, fromImage, readImage, toHash, toPng, toYaml } from './share.js';
import { View } from './view.js';
import { World } from './world.js';

/**
 * The page: what is pressed and drawn goes to the world, and what is there is shown, once a frame.
 *
 * @typedef {object} PageData what `page.py` writes
 * @property {PolicyData} policy
 * @property {MapData[]} maps
 * @property {{map: number, start: number[], goal: number[]}} task the first one
 * @property {string} source how commands name the policy, such as pretrained:best
 */

const SPEEDS = [1, 2, 5, 10, 20, 50];
const MILLISECONDS_A_FRAME = 10; // For steps; the rest is for drawing.
const MILLISECONDS_A_PANEL = 50;
const WALL = 0.2; // m
const WALL_PIXELS = 5; // At least.
const REACH = 14; // Pixels around robot and goal in which they are taken hold of.
const OUTCOMES = { running: 'on its way', reached: 'reached', failed: 'not reached' };
const OTHER = 'other';

class Page {
  /** @param {PageData} data */
  constructor(data) {
    this.data = data;
    this.settings = data.policy.env;
    this.view = new View(byId('map'));
    this.bars = new QBars(byId('q-values'));
    this.showWeights = skillKey(byId('skill-key'), data.policy.algo === 'sqn' ? data.policy.network.num_skills : 1);
    this.manual = new Manual();
    this.isRunning = this.erases = false;
    this.budget = this.lastFrame = this.lastPanels = 0;
    this.cross = this.brush = null;
    this.world = new World(data, this.events());
    this.fillMaps();
    this.setSpeed(1);
    this.world.useMap(data.task.map, data.task);
    this.listen();
  }

  events() {
    return {
      onGrid: (isOther) => (isOther ? this.view.setGrid(this.world.grid) : this.view.gridChanged()),
      onStart: () => {
        this.budget = 0;
        this.manual.clear();
        this.view.forget();
        this.refresh();
      },
      onScan: () => {
        const { env } = this.world.front;
        this.view.addScan(env.pose, env.ranges, env.beamAngles);
        this.needsDrawing = true;
      },
      onName: () => this.showName(),
      say: (text) => this.say(text),
    };
  }

  // Running.

  setRunning(isRunning) {
    if (isRunning && this.world.isOver) this.world.restart();
    this.isRunning = isRunning;
    this.budget = 0;
    this.refresh();
  }

  /** Run, unless the user would rather see no motion that was not asked for. */
  begin() {
    const isCalm = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.setRunning(!isCalm);
    if (isCalm) this.say('Press Run: the policy drives to the star.');
  }

  stepOnce() {
    if (this.world.isManual || this.world.isOver) return;
    this.setRunning(false);
    this.world.advance(() => null);
    this.refresh();
  }

  setManual(isManual) {
    byId('pad').hidden = !isManual;
    if (isManual) {
      this.setSpeed(0);
      byId('map').focus(); // Else the arrow keys would choose who drives.
    }
    this.world.setManual(isManual);
    this.setRunning(true);
    if (isManual) this.say('Arrow keys or W A S D drive. The policy takes a step whenever you do.');
  }

  setSpeed(index) {
    this.speed = SPEEDS[index];
    byId('speed').value = index;
    byId('speed-value').textContent = `${this.speed} ×`;
  }

  frame(now) {
    requestAnimationFrame((next) => this.frame(next));
    const seconds = Math.min(0.1, (now - this.lastFrame) / 1000);
    this.lastFrame = now;
    this.world.applyWalls();
    if (this.isRunning) this.advance(seconds);
    if (!this.needsDrawing) return;
    this.needsDrawing = false;
    this.drawMap();
    if (now - this.lastPanels > MILLISECONDS_A_PANEL || !this.isRunning) {
      this.lastPanels = now;
      this.drawPanels();
    } else this.needsDrawing = true;
  }

  advance(seconds) {
    const end = performance.now() + MILLISECONDS_A_FRAME;
    this.budget += (seconds * this.speed) / this.settings.time_step;
    while (this.budget >= 1 && this.isRunning) {
      this.budget -= 1;
      const isWaiting = !this.world.advance(() => this.manual.take());
      if (isWaiting || performance.now() > end) this.budget = Math.min(this.budget, 1);
      if (isWaiting) return;
      if (this.world.isOver) this.setRunning(false);
    }
  }

  // Showing.

  refresh() {
    this.needsDrawing = true;
    this.lastPanels = 0;
    byId('run').textContent = this.isRunning ? 'Pause' : 'Run';
    byId('undo').disabled = !this.world.undoable.length;
    byId('step').disabled = this.world.isManual || this.world.isOver;
  }

  say(text) {
    byId('message').textContent = text;
  }

  showName() {
    const { label, mapName } = this.world;
    const names = this.data.maps.map((map) => map.name);
    this.otherMap.hidden = mapName !== null;
    if (mapName === null) this.otherMap.textContent = label;
    byId('maps').value = mapName === null ? OTHER : `map ${names.indexOf(mapName)}`;
    this.refresh();
  }

  get thickness() {
    const least = Math.max(3 * this.world.grid.resolution, WALL_PIXELS / (this.view.scale || 1));
    return Math.max(WALL, least);
  }

  drawMap() {
    const { front, episode, isManual, isOver, path, task } = this.world;
    const robots = [front.robot(false)];
    if (isManual) robots.unshift(episode.robot(true));
    this.view.draw({
      robots,
      goal: task.goal,
      goalRadius: this.settings.goal_radius,
      robotRadius: this.settings.robot_radius,
      ranges: front.env.ranges,
      beamAngles: front.env.beamAngles,
      maxRange: this.settings.max_range,
      path: path && (isOver || !this.isRunning) ? path.points : null,
      cross: this.cross,
      brush: this.brush && [...this.brush, this.thickness * (this.erases ? 2 : 1)],
    });
  }

  drawPanels() {
    const { episode, manualEpisode, hasManual, path, isOver, stepsAtEnd } = this.world;
    const shortest = isOver ? stepsAtEnd : path?.steps;
    const { decision, moments } = episode;
    this.bars.show(decision);
    this.showWeights(decision?.weights ?? null);
    drawSkills(byId('skills'), moments, this.view.skillColors);
    drawHidden(byId('memory'), moments);
    drawRewards(byId('rewards'), moments);
    const row = ({ env, outcome }) => [
      String(env.steps),
      outcome === 'reached' && shortest ? (env.steps / shortest).toFixed(2) : '–',
      OUTCOMES[outcome],
    ];
    fillRow('score-policy', row(episode));
    byId('score-you').hidden = !hasManual;
    if (hasManual) fillRow('score-you', row(manualEpisode));
    const length = path ? [String(path.steps), '1', `${path.length.toFixed(1)} m`] : ['–', '–', ''];
    fillRow('score-path', length);
  }

  // In and out.

  async share() {
    const { mapName, grid, task } = this.world;
    this.ownHash = `#${await toHash(mapName, grid, task)}`;
    location.replace(this.ownHash);
    try {
      await navigator.clipboard.writeText(location.href);
      this.say('Link copied: it opens this page with this map and task.');
    } catch {
      this.say('The address of this page now holds this map and task: copy it.');
    }
  }

  async openHash() {
    if (location.hash === this.ownHash) return;
    const names = this.data.maps.map((map) => map.name);
    const shared = await fromHash(location.hash, names);
    if (!shared) return;
    if (shared.mapName !== null) this.world.useMap(names.indexOf(shared.mapName), shared.task);
    else this.world.useOther(shared.grid, 'shared map', shared.task);
    this.begin();
  }

  async save() {
    const { grid, task, maxSteps } = this.world;
    const png = await toPng(grid);
    const isSolvable = this.world.shortestPath() !== null;
    for (const url of this.savedUrls ?? []) URL.revokeObjectURL(url);
    const name = fileName(byId('save-name').value);
    const yaml = toYaml(name, grid, maxSteps, isSolvable ? task : null);
    this.savedUrls = [png, new Blob([yaml])].map((blob) => URL.createObjectURL(blob));
    ['png', 'yaml'].forEach((ending, index) => {
      const link = byId(`save-${ending}`);
      link.href = this.savedUrls[index];
      link.download = link.textContent = `${name}.${ending}`;
    });
    const { source } = this.data;
    byId('save-commands').textContent = [
      `sqn map check ${name}.yaml`,
      `sqn evaluate ${source} --maps ${name}.yaml`,
      `sqn train --start-from ${source} --map ${name}.yaml --learner.discount-start 0`,
    ].join('\n');
    if (!byId('save-dialog').open) byId('save-dialog').showModal();
  }

  async load(input) {
    const [file] = input.files;
    if (!file) return;
    input.value = ''; // The same file can be chosen again, once it is repaired.
    const image = await readImage(file);
    byId('load-size').textContent = `${image.width} x ${image.height} pixels.`;
    const dialog = byId('load-dialog');
    dialog.returnValue = '';
    dialog.showModal();
    await new Promise((resolve) => dialog.addEventListener('close', resolve, { once: true }));
    if (dialog.returnValue !== 'load') return;
    const grid = fromImage(image, Number(byId('load-resolution').value));
    this.world.useOther(grid, fileName(file.name.replace(/\.\w+$/, '')));
    this.setRunning(true);
  }

  fillMaps() {
    const groups = ['Ready', 'At random'].map((label) => {
      const group = document.createElement('optgroup');
      group.label = label;
      return group;
    });
    const option = (value, text) => {
      const element = document.createElement('option');
      element.value = value;
      element.textContent = text;
      return element;
    };
    groups[0].append(...this.data.maps.map(({ name }, index) => option(`map ${index}`, name)));
    groups[1].append(...MAP_KINDS.map((kind) => option(`new ${kind}`, `new ${kind}`)));
    this.otherMap = option(OTHER, '');
    byId('maps').append(...groups, this.otherMap);
  }

  chooseMap(value) {
    const [kind, which] = value.split(' ');
    if (kind === 'map') this.world.useMap(Number(which));
    else if (kind === 'new') this.world.useNew(which);
    this.setRunning(true);
  }

  // Listening.

  listen() {
    /** What a user hands in and cannot be used is a line for the user. */
    const guarded = (act) => async (...given) => {
      try {
        await act(...given);
      } catch (error) {
        if (!(error instanceof RangeError)) throw error;
        this.showName();
        this.say(error.message);
      }
    };
    const commands = {
      run: () => this.setRunning(!this.isRunning),
      step: () => this.stepOnce(),
      restart: () => this.world.restart(),
      task: () => {
        this.world.drawTask();
        this.setRunning(true);
      },
      undo: () => this.world.undo(),
      clear: () => this.world.clear(),
      share: guarded(() => this.share()),
      save: guarded(() => this.save()),
    };
    const on = (id, name, act) => byId(id).addEventListener(name, guarded(act));
    for (const [id, act] of Object.entries(commands)) on(id, 'click', act);
    on('save-name', 'change', commands.save);
    on('maps', 'change', ({ target }) => this.chooseMap(target.value));
    on('load', 'change', ({ target }) => this.load(target));
    on('speed', 'input', ({ target }) => this.setSpeed(Number(target.value)));
    on('tools', 'change', ({ target }) => (this.erases = target.value === 'erase'));
    on('drivers', 'change', ({ target }) => this.setManual(target.value === 'you'));
    window.addEventListener('hashchange', guarded(() => this.openHash()));
    for (const name of Object.keys(this.world.noise)) on(name, 'input', () => this.readNoise());
    this.readNoise();
    this.listenOnMap();
    const keys = { ' ': commands.run, '.': commands.step, 'ctrl+z': commands.undo };
    listenToKeys(this.manual, () => this.world.isManual, keys);
    listenToPad(byId('pad'), this.manual);
    new ResizeObserver(() => this.refresh()).observe(byId('map'));
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
      this.view.readColors();
      this.refresh();
    });
    requestAnimationFrame((now) => this.frame(now));
    guarded(() => this.openHash())();
  }

  readNoise() {
    for (const name of Object.keys(this.world.noise)) {
      const value = Number(byId(name).value);
      byId(name).nextElementSibling.textContent = `${Math.round(100 * value)} %`;
      this.world.noise[name] = value;
    }
    this.world.applyNoise();
  }

  /** What lies under a place. */
  thingAt([x, y]) {
    const { front, task } = this.world;
    const reach = REACH / this.view.scale;
    const isNear = (place, radius) => Math.hypot(place[0] - x, place[1] - y) < Math.max(reach, radius);
    if (isNear(front.env.pose, this.settings.robot_radius)) return 'robot';
    return isNear(task.goal, this.settings.goal_radius) ? 'goal' : null;
  }

  draw(from, to, erases) {
    this.world.draw(from, to, this.thickness * (erases ? 2 : 1), erases);
  }

  listenOnMap() {
    const canvas = byId('map');
    listenToPointer(canvas, (event) => this.view.toMap(event), {
      thingAt: (place) => this.thingAt(place),
      move: (thing, place) => this.world.move(thing, place),
      stroke: (from, to, erases) => this.draw(from, to, erases || this.erases),
      finish: () => this.world.finish(),
      hover: (place) => {
        this.brush = place;
        this.needsDrawing = true;
      },
    });
    const atCross = (act) => () => {
      this.cross ??= this.world.front.env.pose.slice(0, 2);
      act(this.cross);
      this.world.finish();
    };
    const turn = (angle) => () => this.world.move('robot', this.world.front.env.pose, angle);
    const step = (direction) => {
      const from = this.cross ?? this.world.front.env.pose;
      const size = [this.view.width, this.view.height];
      this.cross = direction.map((part, axis) =>
        Math.min(size[axis], Math.max(0, from[axis] + part * 2 * this.thickness)),
      );
      this.needsDrawing = true;
    };
    listenToCross(canvas, () => this.world.isManual, step, {
      enter: atCross((place) => this.draw(place, place, this.erases)),
      r: atCross((place) => this.world.move('robot', place)),
      g: atCross((place) => this.world.move('goal', place)),
      q: turn(Math.PI / 12),
      e: turn(-Math.PI / 12),
    });
    canvas.addEventListener('blur', () => {
      this.cross = null;
      this.needsDrawing = true;
    });
  }
}

/** Start the page. */
function start() {
  const data = JSON.parse(byId('data').textContent);
  byId('beams').textContent = data.policy.env.num_beams;
  byId('policy-name').textContent = `Policy: ${data.policy.name} (${data.policy.algo.toUpperCase()})`;
  new Page(data).begin();
}

start();
