import { Episode, pathOf, randomTask } from './episode.js';
import { generateMap } from './generate.js';
import { unpackMap } from './grid.js';
import { Random } from './random.js';

/**
 * What the page is about: a map that can be edited, a task on it, and the robots that are on their way, that
 * of the policy and, where a person drives, that of the person. It knows nothing of the document.
 *
 * @typedef {object} WorldEvents what the page does when something changes
 * @property {(isOther: boolean) => void} onGrid another map, or other walls
 * @property {() => void} onStart an episode begins
 * @property {() => void} onScan the robot on top has moved
 * @property {() => void} onName the map has another name
 * @property {(text: string) => void} say a line for the user
 */

const USUAL_STEPS = [400, 1200]; // An episode, on maps up to LARGE m and beyond.
const LARGE = 30;
const UNDO_AT_MOST = 200;
const PATH_DELAY = 250; // Milliseconds; while one draws, no path is searched.
const WALLED_OFF = 'The goal is walled off: no path leads there.';

export class World {
  /**
   * @param {PageData} data
   * @param {WorldEvents} events
   */
  constructor(data, events) {
    this.data = data;
    this.settings = data.policy.env;
    this.events = events;
    this.random = new Random(Date.now());
    this.isManual = false;
    this.hasManual = false;
    this.noise = { velocity: 0, range: 0, epsilon: 0 };
    this.wallsHaveChanged = false;
    this.stroke = null;
  }

  /**
   * A map of the page.
   * @param {number} index
   * @param {Task | null} task one at random if null
   */
  useMap(index, task = null) {
    const { name, spawn_points: points, max_steps: steps } = this.data.maps[index];
    this.setGrid(unpackMap(this.data.maps[index]), task, { label: name, mapName: name, points, steps });
  }

  /**
   * A map that is none of the page's.
   * @param {Grid} grid
   * @param {string} label
   * @param {Task | null} task one at random if null, or if no robot can stand there
   * @throws {RangeError} no robot can stand anywhere
   */
  useOther(grid, label, task = null) {
    const size = Math.max(grid.width, grid.height) * grid.resolution;
    const steps = USUAL_STEPS[Number(size > LARGE)];
    this.setGrid(grid, task, { label, mapName: null, points: [], steps });
  }

  /** @param {string} kind one of `MAP_KINDS` */
  useNew(kind) {
    const radius = this.settings.robot_radius;
    const { grid, start, goal } = generateMap(kind, this.random, { radius });
    this.useOther(grid, `random ${kind}`, { start, goal });
  }

  setGrid(grid, task, { label, mapName, points, steps }) {
    const blocked = grid.blockedFor(this.settings.robot_radius);
    const isFree = ([x, y]) => blocked[grid.cellAt(x, y)] === 0;
    const isUsable = task && isFree(task.start) && isFree(task.goal);
    const first = isUsable ? task : randomTask(grid, blocked, points, this.random);
    if (!first) throw new RangeError('No room for the robot on this map.');
    const { policy } = this.data;
    const episodes = [0, 1].map(() => new Episode(policy, grid, new Random(this.random.bits())));
    Object.assign(this, { grid, label, mapName, points, episodes });
    this.maxSteps = this.settings.max_steps || steps;
    this.undoable = [];
    this.stroke = null;
    this.wallsHaveChanged = false;
    [this.episode, this.manualEpisode] = this.episodes;
    this.events.onGrid(true);
    this.events.onName();
    this.setTask(first);
  }

  /** @returns {boolean} whether the robot's center may be there */
  canStand([x, y]) {
    return this.episode.env.isFree(x, y);
  }

  /** A task at random. */
  drawTask() {
    this.applyWalls();
    const task = randomTask(this.grid, this.episode.env.blocked, this.points, this.random);
    if (task) this.setTask(task);
    else this.events.say('No room for the robot on this map.');
  }

  /** @param {Task} task */
  setTask(task) {
    this.task = task;
    this.hasManual = false;
    this.findPath();
    this.restart();
  }

  /** The task from its start. What a person has reached stays, while the policy drives. */
  restart() {
    for (const episode of this.isManual || !this.hasManual ? this.episodes : [this.episode]) {
      episode.start(this.task, this.maxSteps);
    }
    this.hasManual ||= this.isManual;
    this.applyNoise();
    this.events.say('');
    this.events.onStart();
    this.events.onScan();
  }

  /** Hand `noise` on to the robots. */
  applyNoise() {
    const { velocity, range, epsilon } = this.noise;
    for (const episode of this.episodes) {
      episode.env.noise = { velocity, range };
      episode.epsilon = epsilon;
    }
  }

  /** @param {boolean} isManual whether a person drives; the task begins anew */
  setManual(isManual) {
    this.isManual = isManual;
    this.restart();
  }

  /** The shortest path, a moment later. */
  findPath() {
    this.path = undefined;
    clearTimeout(this.pathTimer);
    this.pathTimer = setTimeout(() => this.searchPath(), PATH_DELAY);
  }

  searchPath() {
    clearTimeout(this.pathTimer);
    this.path = this.shortestPath();
    if (!this.path) this.events.say(WALLED_OFF);
    this.events.onName();
  }

  /** @returns {{length: number, points: number[][], steps: number} | null} as `pathOf` has it */
  shortestPath() {
    this.applyWalls();
    return pathOf(this.grid, this.episode.env.blocked, this.task, this.settings);
  }

  // Robots on their way.

  /** The episode of the robot on top. */
  get front() {
    return this.isManual ? this.manualEpisode : this.episode;
  }

  /** Whether all robots have arrived or run out of steps. */
  get isOver() {
    return this.episode.isOver && (!this.isManual || this.manualEpisode.isOver);
  }

  /**
   * One time step of all robots.
   * @param {() => number | null} takeAction the action of the person who drives
   * @returns {boolean} false where it waits for that person
   */
  advance(takeAction) {
    if (this.isManual && !this.manualEpisode.isOver) {
      const action = takeAction();
      if (action === null) return false;
      this.manualEpisode.advance(action);
    }
    if (!this.episode.isOver) this.episode.advance();
    this.events.onScan();
    if (this.isOver) {
      if (this.path === undefined) this.searchPath();
      /** @type {number | undefined} steps of the shortest path among the walls of the episode */
      this.stepsAtEnd = this.path?.steps;
      this.events.say(this.verdict());
    }
    return true;
  }

  verdict() {
    const said = (who, { outcome, env }) => {
      if (outcome !== 'reached') return `${who} did not reach the goal within ${env.steps} steps`;
      const times = this.path ? ` (${(env.steps / this.path.steps).toFixed(2)} × shortest)` : '';
      return `${who} reached the goal in ${env.steps} steps${times}`;
    };
    if (!this.isManual) return `${said('The policy', this.episode)}.`;
    return `${said('You', this.manualEpisode)}, ${said('the policy', this.episode)}.`;
  }

  /**
   * Put robot or goal to another place: a new episode, for the goal from where the robot is.
   * @param {string} thing robot or goal
   * @param {number[]} place x m, y m; nothing happens where the robot does not fit
   * @param {number} turn of the robot, rad
   */
  move(thing, place, turn = 0) {
    const { pose } = this.front.env;
    if (!this.canStand(place)) return;
    if (thing === 'goal') this.setTask({ start: [...pose], goal: place.slice(0, 2) });
    else this.setTask({ start: [...place.slice(0, 2), pose[2] + turn], goal: this.task.goal });
  }

  // Walls.

  /**
   * Draw or erase along a line. Walls keep away from robots and goal. All until `finish` is undone as one.
   * @param {number[]} from x m, y m
   * @param {number[]} to x m, y m
   * @param {number} thickness m
   * @param {boolean} erases
   */
  draw(from, to, thickness, erases) {
    const value = erases ? 0 : 1;
    const { occupied } = this.grid;
    const robots = this.isManual ? this.episodes : [this.episode];
    const keptFree = [...robots.map(({ env }) => env.pose), this.task.start, this.task.goal];
    const distance = this.settings.robot_radius + 2 * this.grid.resolution;
    const cells = this.grid.strokeCells(from, to, thickness).filter((cell) => {
      if (occupied[cell] === value) return false;
      const [x, y] = this.grid.centerOf(cell);
      return erases || keptFree.every((place) => Math.hypot(place[0] - x, place[1] - y) > distance);
    });
    this.change(cells, value);
  }

  /** Take all walls away but for the border. */
  clear() {
    const { occupied } = this.grid;
    this.change([...occupied.keys()].filter((cell) => occupied[cell]), 0);
    this.finish();
  }

  change(cells, value) {
    this.stroke ??= { cells: new Set(), value };
    cells.forEach((cell) => this.stroke.cells.add(cell));
    this.grid.setCells(cells, value);
    this.wallsHaveChanged ||= cells.length > 0;
  }

  /** End of a stroke. */
  finish() {
    const { stroke } = this;
    this.stroke = null;
    if (!stroke?.cells.size) return;
    this.undoable.push(stroke);
    this.undoable.splice(0, this.undoable.length - UNDO_AT_MOST);
    if (this.mapName !== null) this.label = `${this.mapName}, edited`;
    this.mapName = null;
    this.findPath();
    this.events.onName();
  }

  /** Take the last stroke back. */
  undo() {
    const last = this.undoable.pop();
    if (!last) return;
    this.grid.setCells(last.cells, 1 - last.value);
    this.wallsHaveChanged = true;
    this.applyWalls();
    const isStuck = this.episodes.some(({ env }) => !this.canStand(env.pose));
    if (!this.canStand(this.task.goal) || !this.canStand(this.task.start)) this.drawTask();
    else if (isStuck) this.restart();
    this.findPath();
    this.events.onName();
  }

  /** Let the robots know of walls, if any have changed; once a frame is enough. */
  applyWalls() {
    if (!this.wallsHaveChanged) return;
    this.wallsHaveChanged = false;
    for (const { env } of this.episodes) env.gridChanged();
    this.events.onGrid(false);
    this.events.onScan();
  }
}
