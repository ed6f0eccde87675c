import { ACTION_NAMES } from './env.js';
import { channels, fitted, mixed, styleColor } from './view.js';

/**
 * What stands beside the map: step counts, Q-values, and strips of skill weights, hidden state and reward
 * over the last steps. All three strips have the same steps above each other.
 */

const PIXELS_PER_STEP = 2;
const SMALLEST_REWARD_SCALE = 1;

/**
 * @param {string} id of an element of the page
 * @returns {HTMLElement}
 */
export function byId(id) {
  return document.getElementById(id);
}

/**
 * Fill a row of the table of steps.
 * @param {string} id of the row
 * @param {string[]} texts of its cells
 */
export function fillRow(id, texts) {
  byId(id)
    .querySelectorAll('td')
    .forEach((cell, index) => {
      if (cell.textContent !== texts[index]) cell.textContent = texts[index];
    });
}

/** Bars of the Q-values, made once. */
export class QBars {
  /** @param {HTMLElement} list */
  constructor(list) {
    this.rows = ACTION_NAMES.map((name) => {
      const [row, label, track, bar, value] = ['li', 'span', 'span', 'i', 'span'].map((tag) =>
        document.createElement(tag),
      );
      label.className = 'name';
      label.textContent = name;
      track.className = 'track';
      value.className = 'value';
      track.append(bar);
      row.append(label, track, value);
      list.append(row);
      return { row, bar, value };
    });
  }

  /**
   * Bars over the span from the lowest to the highest value, since what counts is what they differ by.
   * @param {Decision | null} decision
   */
  show(decision) {
    const values = decision?.qValues ?? [];
    const low = Math.min(...values);
    const span = Math.max(Math.max(...values) - low, 1e-6);
    this.rows.forEach(({ row, bar, value }, action) => {
      const fraction = decision ? 0.06 + (0.94 * (values[action] - low)) / span : 0;
      bar.style.transform = `scaleX(${fraction})`;
      value.textContent = decision ? values[action].toFixed(2) : '–';
      row.className = decision?.action === action ? 'chosen' : '';
      row.ariaCurrent = row.className ? 'true' : null;
    });
  }
}

/**
 * Fit a strip, and find the steps that it has room for.
 * @param {HTMLCanvasElement} canvas
 * @param {Moment[]} moments
 */
function stripOf(canvas, moments) {
  const { context, width, height } = fitted(canvas);
  const shown = moments.slice(-Math.floor(width / PIXELS_PER_STEP));
  return { context, width, height, shown };
}

/**
 * Skill weights, one above the other, the first at the bottom.
 * @param {HTMLCanvasElement} canvas
 * @param {Moment[]} moments
 * @param {number[][]} colors of the skills
 */
export function drawSkills(canvas, moments, colors) {
  const { context, height, shown } = stripOf(canvas, moments);
  const fills = colors.map((color) => mixed([color], [1]));
  shown.forEach(({ weights }, index) => {
    let bottom = height;
    for (let skill = 0; skill < weights.length; skill += 1) {
      context.fillStyle = fills[skill % fills.length];
      const size = weights[skill] * height;
      context.fillRect(index * PIXELS_PER_STEP, bottom - size, PIXELS_PER_STEP, size);
      bottom -= size;
    }
  });
}

/**
 * Hidden state: a row for each unit, a column for each step.
 * @param {HTMLCanvasElement} canvas
 * @param {Moment[]} moments
 */
export function drawHidden(canvas, moments) {
  const { context, height, shown } = stripOf(canvas, moments);
  if (!shown.length) return;
  const units = shown[0].hidden.length;
  const colors = ['ground', 'cold', 'warm'].map((name) => channels(styleColor(name)));
  const image = new ImageData(shown.length, units);
  shown.forEach(({ hidden }, column) => {
    for (let unit = 0; unit < units; unit += 1) {
      const value = Math.max(-1, Math.min(1, hidden[unit]));
      const color = value < 0 ? colors[1] : colors[2];
      const place = 4 * (unit * shown.length + column);
      for (let channel = 0; channel < 3; channel += 1) {
        const zero = colors[0][channel];
        image.data[place + channel] = zero + Math.abs(value) * (color[channel] - zero);
      }
      image.data[place + 3] = 255;
    }
  });
  const small = document.createElement('canvas');
  small.width = shown.length;
  small.height = units;
  small.getContext('2d').putImageData(image, 0, 0);
  context.imageSmoothingEnabled = false;
  context.drawImage(small, 0, 0, shown.length * PIXELS_PER_STEP, height);
}

/**
 * Reward: the terms for goal and area as bars, the total as a line.
 * @param {HTMLCanvasElement} canvas
 * @param {Moment[]} moments
 */
export function drawRewards(canvas, moments) {
  const { context, height, shown } = stripOf(canvas, moments);
  const largest = Math.max(
    SMALLEST_REWARD_SCALE,
    ...shown.map(({ reward }) => reward.navigation + reward.exploration),
  );
  const lowest = Math.min(-0.25, ...shown.map(({ reward }) => reward.total));
  const perUnit = height / (largest - lowest);
  const zero = height + lowest * perUnit;
  const terms = ['navigation', 'exploration'].map((term) => [term, styleColor(term)]);
  shown.forEach(({ reward }, index) => {
    const left = index * PIXELS_PER_STEP;
    let bottom = zero;
    for (const [term, color] of terms) {
      context.fillStyle = color;
      const size = Math.max(0, reward[term]) * perUnit;
      context.fillRect(left, bottom - size, PIXELS_PER_STEP, size);
      bottom -= size;
    }
  });
  context.strokeStyle = styleColor('total');
  context.lineWidth = 1.2;
  context.beginPath();
  shown.forEach(({ reward }, index) => {
    context.lineTo((index + 0.5) * PIXELS_PER_STEP, zero - reward.total * perUnit);
  });
  context.stroke();
}

/**
 * The key of the skills, with their weights in the last step.
 * @param {HTMLElement} element
 * @param {number} count of skills
 * @returns {(weights: ArrayLike<number> | null) => void} shows weights
 */
export function skillKey(element, count) {
  if (count < 2) {
    element.textContent = 'one head, no skills';
    return () => {};
  }
  const values = Array.from({ length: count }, (_, skill) => {
    const [square, value] = ['i', 'span'].map((tag) => document.createElement(tag));
    square.style.background = `var(--skill-${skill % 6})`;
    element.append(square, value);
    return value;
  });
  return (weights) => {
    values.forEach((value, skill) => {
      value.textContent = `${skill + 1}: ${weights ? weights[skill].toFixed(2) : '–'}`;
    });
  };
}
