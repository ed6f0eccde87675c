import { Grid, packMap, unpackMap } from './grid.js';

/**
 * Maps out of the page and into it: in the address after the #, as PNG and YAML, from an image.
 * What comes from outside is checked before it is used; what cannot be used throws a RangeError of one line.
 */

const MOST_CELLS = 2 ** 21;
const SIZES = [0.01, 1]; // m per cell
const FREE_GRAY = 254;
const FREE_BELOW = 0.196; // Occupancy, as map_server reads an image by default.
const NAME = /^[A-Za-z0-9_][A-Za-z0-9_-]{0,39}$/;

/**
 * The text after the # for a map and a task.
 * @param {string | null} mapName of a map of the page that is as it was; else null, and the cells are packed
 * @param {Grid} grid
 * @param {Task} task
 * @returns {Promise<string>} without the #
 */
export async function toHash(mapName, grid, task) {
  const fields = new URLSearchParams();
  if (mapName !== null) fields.set('map', mapName);
  else {
    fields.set('size', [grid.width, grid.height].join());
    fields.set('resolution', grid.resolution);
    fields.set('origin', grid.origin.join());
    fields.set('cells', await squeezed(packMap(grid)));
  }
  fields.set('start', task.start.map((value) => Number(value.toFixed(4))).join());
  fields.set('goal', task.goal.map((value) => Number(value.toFixed(4))).join());
  return fields.toString();
}

/**
 * What a text after the # says.
 * @param {string} hash with or without the #
 * @param {string[]} names of the maps of the page
 * @returns {Promise<{mapName: string | null, grid: Grid | null, task: Task | null} | null>} null if empty
 * @throws {RangeError}
 */
export async function fromHash(hash, names) {
  const fields = new URLSearchParams(hash.replace(/^#/, ''));
  if (!fields.has('map') && !fields.has('cells')) return null;
  let [mapName, grid, task] = [null, null, null];
  if (fields.has('map')) {
    mapName = fields.get('map');
    if (!names.includes(mapName)) throw new RangeError('The link names a map that is not in this page.');
  } else {
    const [width, height] = numbers(fields, 'size', 2);
    requireSize(width, height);
    const [resolution] = numbers(fields, 'resolution', 1);
    requireResolution(resolution);
    const origin = fields.has('origin') ? numbers(fields, 'origin', 3) : [0, 0, 0];
    const cells = await unsqueezed(fields.get('cells'), Math.ceil((width * height) / 8));
    grid = unpackMap({ width, height, resolution, origin, cells });
  }
  if (fields.has('start') && fields.has('goal')) {
    task = { start: numbers(fields, 'start', 3), goal: numbers(fields, 'goal', 2) };
  }
  return { mapName, grid, task };
}

function numbers(fields, name, count) {
  const values = (fields.get(name) ?? '').split(',').map((text) => (text.trim() ? Number(text) : NaN));
  if (values.length !== count || !values.every((value) => Math.abs(value) < 1e6)) {
    throw new RangeError(`The link is damaged: ${name} is no list of ${count} numbers.`);
  }
  return values;
}

/**
 * @param {number} width columns
 * @param {number} height rows
 * @throws {RangeError}
 */
export function requireSize(width, height) {
  const whole = Number.isInteger(width) && Number.isInteger(height) && Math.min(width, height) >= 8;
  if (!whole || width * height > MOST_CELLS) {
    throw new RangeError(`The map has ${width} x ${height} cells; 8 x 8 to ${MOST_CELLS} in all can be used.`);
  }
}

/**
 * @param {number} resolution m per cell
 * @throws {RangeError}
 */
export function requireResolution(resolution) {
  if (!(resolution >= SIZES[0] && resolution <= SIZES[1])) {
    throw new RangeError(`A cell of ${resolution} m; ${SIZES[0]} to ${SIZES[1]} m can be used.`);
  }
}

function fromBase64(text) {
  const standard = text.replaceAll('-', '+').replaceAll('_', '/');
  try {
    return Uint8Array.from(atob(standard), (sign) => sign.charCodeAt(0));
  } catch {
    throw new RangeError('The link is damaged: its map cannot be read.');
  }
}

function toBase64(bytes) {
  let text = '';
  for (const byte of bytes) text += String.fromCharCode(byte);
  return btoa(text);
}

/** Base64 of bytes -> deflated, in the signs that addresses take as they are. */
async function squeezed(cells) {
  const stream = new Blob([fromBase64(cells)]).stream();
  const deflated = stream.pipeThrough(new CompressionStream('deflate-raw'));
  const bytes = new Uint8Array(await new Response(deflated).arrayBuffer());
  return toBase64(bytes).replaceAll('+', '-').replaceAll('/', '_').replace(/=+$/, '');
}

/** The way back, to exactly `length` bytes: what would grow beyond is not unpacked further. */
async function unsqueezed(text, length) {
  const stream = new Blob([fromBase64(text)]).stream();
  const reader = stream.pipeThrough(new DecompressionStream('deflate-raw')).getReader();
  const bytes = new Uint8Array(length);
  let filled = 0;
  try {
    for (let part = await reader.read(); !part.done; part = await reader.read()) {
      if (filled + part.value.length > length) throw new RangeError();
      bytes.set(part.value, filled);
      filled += part.value.length;
    }
  } catch {
    filled = -1;
  }
  reader.cancel().catch(() => {});
  if (filled !== length) throw new RangeError('The link is damaged: its map cannot be read.');
  return toBase64(bytes);
}

/**
 * @param {Grid} grid
 * @returns {Promise<Blob>} a PNG file: black is occupied
 */
export async function toPng(grid) {
  const canvas = document.createElement('canvas');
  canvas.width = grid.width;
  canvas.height = grid.height;
  const context = canvas.getContext('2d');
  const image = context.createImageData(grid.width, grid.height);
  for (let cell = 0; cell < grid.occupied.length; cell += 1) {
    const column = cell % grid.width;
    const row = grid.height - 1 - (cell - column) / grid.width;
    const place = 4 * (row * grid.width + column);
    image.data.fill(grid.occupied[cell] ? 0 : FREE_GRAY, place, place + 3);
    image.data[place + 3] = 255;
  }
  context.putImageData(image, 0, 0);
  return new Promise((resolve) => canvas.toBlob(resolve, 'image/png'));
}

/**
 * @param {string} name as a user types it
 * @returns {string} one that is safe in a file's name and in a command
 */
export function fileName(name) {
  const plain = name.trim().replace(/[^A-Za-z0-9_-]+/g, '_').replace(/^-+/, '').slice(0, 40);
  return NAME.test(plain) ? plain : 'my_map';
}

/**
 * The YAML file beside the PNG, for ROS map_server and `sqn map check`.
 * @param {string} name of both files, without ending
 * @param {Grid} grid
 * @param {number} maxSteps steps an episode
 * @param {Task | null} task its places become the evaluation points; null if no path joins them
 * @returns {string}
 */
export function toYaml(name, grid, maxSteps, task) {
  const lines = [
    `image: ${name}.png`,
    'mode: trinary',
    `resolution: ${grid.resolution}`,
    `origin: [${grid.origin.join(', ')}]`,
    'negate: 0',
    'occupied_thresh: 0.65',
    'free_thresh: 0.196',
    `max_steps: ${maxSteps}`,
  ];
  if (task) {
    const places = [task.start, task.goal].map((place) => toMapFrame(grid.origin, place));
    lines.push('evaluation_points:', ...places.map((place) => `  - [${place.join(', ')}]`));
  }
  return `${lines.join('\n')}\n`;
}

function toMapFrame([left, bottom, yaw], [x, y]) {
  const [cosine, sine] = [Math.cos(yaw), Math.sin(yaw)];
  return [left + cosine * x - sine * y, bottom + sine * x + cosine * y];
}

/**
 * The pixels of an image file.
 * @param {File} file
 * @returns {Promise<ImageData>}
 * @throws {RangeError}
 */
export async function readImage(file) {
  let bitmap = null;
  try {
    bitmap = await createImageBitmap(file);
  } catch {
    throw new RangeError('This file cannot be read as an image.');
  }
  requireSize(bitmap.width, bitmap.height);
  const canvas = document.createElement('canvas');
  canvas.width = bitmap.width;
  canvas.height = bitmap.height;
  const context = canvas.getContext('2d');
  context.drawImage(bitmap, 0, 0);
  return context.getImageData(0, 0, bitmap.width, bitmap.height);
}

/**
 * The map that an image draws: light is free, all else and what is transparent is occupied.
 * @param {ImageData} image
 * @param {number} resolution m per pixel
 * @returns {Grid}
 * @throws {RangeError}
 */
export function fromImage(image, resolution) {
  requireResolution(resolution);
  const { width, height, data } = image;
  const occupied = new Uint8Array(width * height);
  for (let place = 0; place < width * height; place += 1) {
    const [red, green, blue, alpha] = data.subarray(4 * place, 4 * place + 4);
    const isFree = alpha === 255 && 1 - (red + green + blue) / 765 < FREE_BELOW;
    const column = place % width;
    const row = height - 1 - (place - column) / width;
    occupied[row * width + column] = isFree ? 0 : 1;
  }
  return new Grid(width, height, resolution, [0, 0, 0], occupied);
}
