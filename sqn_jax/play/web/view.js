/**
 * The picture of the map: walls, what was seen, beams, trails, goal and robots. It only draws; where things
 * are is what `Scene` says. Colors come from the style sheet, so that they follow light and dark.
 *
 * @typedef {object} Robot
 * @property {number[]} pose x m, y m, heading rad
 * @property {number[][]} trail places x m, y m, in order
 * @property {Float32Array[]} weights skill weights on the way to each place of the trail but the first
 * @property {boolean} isGhost drawn pale, without beams
 *
 * @typedef {object} Scene
 * @property {Robot[]} robots the last one on top
 * @property {number[]} goal x m, y m
 * @property {number} goalRadius m
 * @property {number} robotRadius m
 * @property {Float64Array} ranges readings of the robot on top, m
 * @property {Float64Array} beamAngles rad
 * @property {number} maxRange m
 * @property {number[][] | null} path corners x m, y m of the shortest path, if it is shown
 * @property {number[] | null} cross x m, y m of the keyboard's cross
 * @property {number[] | null} brush x m, y m of the pointer, and its thickness m
 */

const SEEN_PIXELS_PER_METER = 30;
const SEEN_PIXELS_AT_MOST = 1024;
const SMALLEST_ROBOT = 8; // Pixels of its radius.
const WEIGHT_LEVELS = 10;

/**
 * A color of the style sheet.
 * @param {string} name of a custom property, without the hyphens
 * @returns {string}
 */
export function styleColor(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/**
 * @param {string} color #rrggbb
 * @returns {number[]} red, green, blue, 0..255
 */
export function channels(color) {
  return [1, 3, 5].map((place) => parseInt(color.slice(place, place + 2), 16));
}

/**
 * The colors of skills mixed by their weights.
 * @param {number[][]} colors [K][3] of the skills
 * @param {ArrayLike<number>} weights [K]
 * @returns {string}
 */
export function mixed(colors, weights) {
  const sums = [0, 0, 0];
  for (let skill = 0; skill < weights.length; skill += 1) {
    const color = colors[skill % colors.length];
    for (let channel = 0; channel < 3; channel += 1) sums[channel] += weights[skill] * color[channel];
  }
  return `rgb(${sums.map(Math.round).join(' ')})`;
}

/**
 * Fit a canvas to the pixels of the screen.
 * @param {HTMLCanvasElement} canvas
 * @returns {{context: CanvasRenderingContext2D, width: number, height: number}} in CSS pixels
 */
export function fitted(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  const columns = Math.max(1, Math.round(width * ratio));
  const rows = Math.max(1, Math.round(height * ratio));
  if (canvas.width !== columns || canvas.height !== rows) {
    canvas.width = columns;
    canvas.height = rows;
  }
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** Names of the colors that the map is drawn with. */
const MAP_COLORS = ['wall', 'ground', 'seen', 'fan', 'robot', 'goal', 'path', 'card'];

export class View {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.walls = document.createElement('canvas');
    this.seen = document.createElement('canvas');
    this.grid = null;
    this.readColors();
  }

  /** Look the colors up again, after a change from light to dark. */
  readColors() {
    this.colors = Object.fromEntries(MAP_COLORS.map((name) => [name, styleColor(name)]));
    this.skillColors = skillColors();
    if (!this.grid) return;
    this.gridChanged();
    const context = this.seen.getContext('2d');
    context.globalCompositeOperation = 'source-in'; // Only where there is color already.
    context.fillStyle = this.colors.seen;
    context.fillRect(0, 0, this.seen.width, this.seen.height);
    context.globalCompositeOperation = 'source-over';
  }

  /** @param {Grid} grid another map */
  setGrid(grid) {
    this.grid = grid;
    this.width = grid.width * grid.resolution;
    this.height = grid.height * grid.resolution;
    const longest = Math.max(this.width, this.height);
    this.seenScale = Math.min(SEEN_PIXELS_PER_METER, SEEN_PIXELS_AT_MOST / longest);
    this.seen.width = Math.ceil(this.width * this.seenScale);
    this.seen.height = Math.ceil(this.height * this.seenScale);
    this.gridChanged();
  }

  /** Draw the walls anew. */
  gridChanged() {
    const { width, height, occupied } = this.grid;
    this.walls.width = width;
    this.walls.height = height;
    const context = this.walls.getContext('2d');
    const image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    const [red, green, blue] = channels(this.colors.wall);
    const wall = new Uint32Array(new Uint8Array([red, green, blue, 255]).buffer)[0];
    for (let row = 0; row < height; row += 1) {
      const above = (height - 1 - row) * width;
      for (let column = 0; column < width; column += 1) {
        if (occupied[row * width + column]) pixels[above + column] = wall;
      }
    }
    context.putImageData(image, 0, 0);
  }

  /** Forget what was seen. */
  forget() {
    this.seen.getContext('2d').clearRect(0, 0, this.seen.width, this.seen.height);
  }

  /**
   * Add what a scan sees to the ground that was seen.
   * @param {number[]} pose x m, y m, heading rad
   * @param {Float64Array} ranges m
   * @param {Float64Array} beamAngles rad
   */
  addScan(pose, ranges, beamAngles) {
    const context = this.seen.getContext('2d');
    context.setTransform(this.seenScale, 0, 0, -this.seenScale, 0, this.seen.height);
    context.fillStyle = this.colors.seen;
    tracedSectors(context, pose, ranges, beamAngles);
    context.fill();
    context.setTransform(1, 0, 0, 1, 0, 0);
  }

  /** Fit the map into the canvas; pixels per meter, and where its lower left corner is. */
  place(width, height) {
    this.scale = Math.min(width / this.width, height / this.height);
    this.left = (width - this.scale * this.width) / 2;
    this.bottom = (height + this.scale * this.height) / 2;
  }

  /**
   * @param {{clientX: number, clientY: number}} event
   * @returns {number[]} x m, y m on the map
   */
  toMap(event) {
    const bounds = this.canvas.getBoundingClientRect();
    const x = (event.clientX - bounds.left - this.left) / this.scale;
    return [x, (this.bottom - event.clientY + bounds.top) / this.scale];
  }

  /** @param {Scene} scene */
  draw(scene) {
    const { context, width, height } = fitted(this.canvas);
    this.place(width, height);
    const { scale, left, bottom, colors } = this;
    const box = [left, bottom - scale * this.height, scale * this.width, scale * this.height];
    context.fillStyle = colors.ground;
    context.fillRect(...box);
    context.drawImage(this.seen, ...box);
    context.save();
    context.translate(left, bottom);
    context.scale(scale, -scale);
    this.drawBeams(context, scene);
    context.restore();
    context.imageSmoothingEnabled = scale * this.grid.resolution < 1.5;
    context.drawImage(this.walls, ...box);
    context.save();
    context.translate(left, bottom);
    context.scale(scale, -scale);
    context.lineJoin = context.lineCap = 'round';
    if (scene.path) this.drawPath(context, scene.path);
    for (const robot of scene.robots) this.drawTrail(context, robot);
    this.drawGoal(context, scene);
    for (const robot of scene.robots) this.drawRobot(context, robot, scene.robotRadius);
    this.drawPointer(context, scene);
    context.restore();
  }

  /** What the robot on top sees now. */
  drawBeams(context, { robots, ranges, beamAngles, maxRange }) {
    const { pose } = robots[robots.length - 1];
    context.fillStyle = context.strokeStyle = this.colors.fan;
    context.globalAlpha = 0.28;
    tracedSectors(context, pose, ranges, beamAngles);
    context.fill();
    context.globalAlpha = 0.55;
    context.lineWidth = 0.8 / this.scale;
    context.beginPath();
    const hits = [];
    for (let beam = 0; beam < ranges.length; beam += 1) {
      const angle = pose[2] + beamAngles[beam];
      const x = pose[0] + ranges[beam] * Math.cos(angle);
      const y = pose[1] + ranges[beam] * Math.sin(angle);
      context.moveTo(pose[0], pose[1]);
      context.lineTo(x, y);
      if (ranges[beam] < maxRange) hits.push([x, y]);
    }
    context.stroke();
    context.globalAlpha = 1;
    for (const [x, y] of hits) disc(context, x, y, 1.7 / this.scale);
  }

  drawPath(context, path) {
    context.strokeStyle = this.colors.path;
    context.lineWidth = 1.6 / this.scale;
    context.setLineDash([5 / this.scale, 5 / this.scale]);
    context.beginPath();
    for (const [x, y] of path) context.lineTo(x, y);
    context.stroke();
    context.setLineDash([]);
  }

  /** A trail in the colors of the skills, a line for each run of like weights. */
  drawTrail(context, { trail, weights, isGhost }) {
    context.lineWidth = (isGhost ? 2 : 3.2) / this.scale;
    context.globalAlpha = isGhost ? 0.55 : 1;
    let level = '';
    for (let index = 1; index < trail.length; index += 1) {
      const rounded = Array.from(weights[index - 1], (weight) => Math.round(weight * WEIGHT_LEVELS));
      if (rounded.join() !== level) {
        if (level) context.stroke();
        level = rounded.join();
        context.strokeStyle = mixed(this.skillColors, weights[index - 1]);
        context.beginPath();
        context.moveTo(...trail[index - 1]);
      }
      context.lineTo(...trail[index]);
    }
    if (level) context.stroke();
    context.globalAlpha = 1;
  }

  /** A star, and the circle within which the goal counts as reached. */
  drawGoal(context, { goal, goalRadius }) {
    const radius = Math.max(goalRadius, 9 / this.scale);
    context.fillStyle = context.strokeStyle = this.colors.goal;
    context.globalAlpha = 0.3;
    disc(context, goal[0], goal[1], radius);
    context.globalAlpha = 1;
    context.lineWidth = 1.6 / this.scale;
    context.beginPath();
    context.arc(goal[0], goal[1], radius, 0, 2 * Math.PI);
    context.stroke();
    context.beginPath();
    for (let corner = 0; corner < 10; corner += 1) {
      const length = (corner % 2 ? 0.34 : 0.82) * radius;
      const angle = Math.PI / 2 + (corner * Math.PI) / 5;
      context.lineTo(goal[0] + length * Math.cos(angle), goal[1] + length * Math.sin(angle));
    }
    context.closePath();
    context.fill();
  }

  /** A disc with an arrow in it; larger than life on large maps. */
  drawRobot(context, { pose, isGhost }, robotRadius) {
    const radius = Math.max(robotRadius, SMALLEST_ROBOT / this.scale);
    context.save();
    context.translate(pose[0], pose[1]);
    context.rotate(pose[2]);
    context.globalAlpha = isGhost ? 0.6 : 1;
    context.fillStyle = isGhost ? this.colors.card : this.colors.robot;
    context.strokeStyle = isGhost ? this.colors.robot : this.colors.card;
    context.lineWidth = 1.5 / this.scale;
    disc(context, 0, 0, radius);
    context.stroke();
    context.fillStyle = isGhost ? this.colors.robot : this.colors.card;
    context.beginPath();
    context.moveTo(0.78 * radius, 0);
    context.lineTo(-0.5 * radius, 0.52 * radius);
    context.lineTo(-0.2 * radius, 0);
    context.lineTo(-0.5 * radius, -0.52 * radius);
    context.fill();
    context.restore();
  }

  drawPointer(context, { cross, brush }) {
    context.strokeStyle = styleColor('focus');
    context.lineWidth = 1.5 / this.scale;
    if (brush) {
      context.beginPath();
      context.arc(brush[0], brush[1], brush[2] / 2, 0, 2 * Math.PI);
      context.stroke();
    }
    if (!cross) return;
    const arm = 10 / this.scale;
    context.lineWidth = 2.5 / this.scale;
    context.beginPath();
    context.moveTo(cross[0] - arm, cross[1]);
    context.lineTo(cross[0] + arm, cross[1]);
    context.moveTo(cross[0], cross[1] - arm);
    context.lineTo(cross[0], cross[1] + arm);
    context.stroke();
  }
}

/** @returns {number[][]} the colors of the skills, [6][3] */
export function skillColors() {
  return [0, 1, 2, 3, 4, 5].map((skill) => channels(styleColor(`skill-${skill}`)));
}

/** The sectors that a scan sees: each as far as its beam reads, half a beam's distance to each side. */
function tracedSectors(context, [x, y, heading], ranges, beamAngles) {
  const half = (beamAngles[1] - beamAngles[0]) / 2;
  const last = ranges.length - 1;
  context.beginPath();
  context.moveTo(x, y);
  for (let beam = 0; beam <= last; beam += 1) {
    const angle = heading + beamAngles[beam];
    const [low, high] = [beam > 0 ? angle - half : angle, beam < last ? angle + half : angle];
    context.lineTo(x + ranges[beam] * Math.cos(low), y + ranges[beam] * Math.sin(low));
    context.lineTo(x + ranges[beam] * Math.cos(high), y + ranges[beam] * Math.sin(high));
  }
  context.closePath();
}

function disc(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}
