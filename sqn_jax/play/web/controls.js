import { BACKWARD, FORWARD, LEFT, RIGHT } from './env.js';

/**
 * Mouse, finger and keyboard. What they mean is up to the handlers that the page gives.
 *
 * @typedef {object} MapHandlers
 * @property {(place: number[]) => 'robot' | 'goal' | null} thingAt what lies under a place x m, y m
 * @property {(thing: string, place: number[]) => void} move a robot or goal
 * @property {(from: number[], to: number[], erase: boolean) => void} stroke
 * @property {() => void} finish a drag or stroke has ended
 * @property {(place: number[] | null) => void} hover
 */

const ACTION_KEYS = {
  ArrowUp: FORWARD, KeyW: FORWARD, ArrowDown: BACKWARD, KeyS: BACKWARD,
  ArrowLeft: LEFT, KeyA: LEFT, ArrowRight: RIGHT, KeyD: RIGHT,
};
const CROSS_KEYS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };

/**
 * Drag the robot and the goal; draw where there is neither, erase with the right button.
 * @param {HTMLCanvasElement} canvas
 * @param {(event: PointerEvent) => number[]} toMap
 * @param {MapHandlers} handlers
 */
export function listenToPointer(canvas, toMap, handlers) {
  let thing = null;
  let last = null;
  let pointer = null;
  let erases = false;
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('pointerdown', (event) => {
    if (last || event.button > 2) return;
    pointer = event.pointerId;
    canvas.setPointerCapture(pointer);
    last = toMap(event);
    erases = event.button === 2;
    thing = erases ? null : handlers.thingAt(last);
    if (!thing) handlers.stroke(last, last, erases);
  });
  canvas.addEventListener('pointermove', (event) => {
    if (last && event.pointerId !== pointer) return; // A second finger.
    const place = toMap(event);
    if (last && thing) handlers.move(thing, place);
    else if (last) handlers.stroke(last, place, erases);
    if (last) last = place;
    handlers.hover(event.pointerType === 'mouse' ? place : null);
    canvas.style.cursor = thing || handlers.thingAt(place) ? 'grab' : 'crosshair';
  });
  const end = (event) => {
    if (event.pointerId !== pointer) return;
    if (last) handlers.finish();
    last = thing = null;
  };
  canvas.addEventListener('pointerup', end);
  canvas.addEventListener('pointercancel', end);
  canvas.addEventListener('pointerleave', () => handlers.hover(null));
}

/** The action that a person asks for by keys or buttons: a tap counts once, what is held goes on. */
export class Manual {
  constructor() {
    this.held = [];
    this.tapped = null;
  }

  /** @param {number} action pressed now */
  press(action) {
    this.tapped = action;
    this.release(action);
    this.held.push(action);
  }

  /** @param {number} action let go of */
  release(action) {
    this.held = this.held.filter((other) => other !== action);
  }

  /** Let go of everything. */
  clear() {
    this.held = [];
    this.tapped = null;
  }

  /** @returns {number | null} the action for the next step, if there is one */
  take() {
    const action = this.tapped ?? this.held[this.held.length - 1] ?? null;
    this.tapped = null;
    return action;
  }
}

/**
 * The buttons beside the map that drive: held as keys are.
 * @param {HTMLElement} pad holds buttons with `data-action`
 * @param {Manual} manual
 */
export function listenToPad(pad, manual) {
  for (const button of pad.querySelectorAll('button')) {
    const action = Number(button.dataset.action);
    button.addEventListener('pointerdown', (event) => {
      event.preventDefault();
      manual.press(action);
    });
    for (const name of ['pointerup', 'pointercancel', 'pointerleave']) {
      button.addEventListener(name, () => manual.release(action));
    }
    // Enter and Space press a button without a pointer.
    button.addEventListener('click', (event) => {
      if (event.detail === 0) manual.tapped = action;
    });
  }
}

/**
 * Keys for the whole page.
 * @param {Manual} manual
 * @param {() => boolean} isManual whether a person drives
 * @param {Object<string, () => void>} commands by key, such as ' ', '.', 'ctrl+z'
 */
export function listenToKeys(manual, isManual, commands) {
  document.addEventListener('keydown', (event) => {
    const { target } = event;
    const isTyping = target.matches('input:not([type=radio]), select, textarea') || target.closest('dialog');
    const isControl = target.matches('button, input, summary, a');
    if (isTyping || event.altKey || event.metaKey) return;
    const action = ACTION_KEYS[event.code];
    const name = (event.ctrlKey ? 'ctrl+' : '') + event.key.toLowerCase();
    // Arrows choose among radio buttons, and Space presses what has the focus.
    const isArrow = target.type === 'radio' && event.key.startsWith('Arrow');
    const isTaken = isControl && (event.key === ' ' || event.key === 'Enter' || isArrow);
    if (isManual() && action !== undefined && !event.ctrlKey && !isTaken) {
      if (!event.repeat) manual.press(action);
    } else if (commands[name] && !isTaken) {
      commands[name]();
    } else return;
    event.preventDefault();
  });
  document.addEventListener('keyup', (event) => {
    if (event.code in ACTION_KEYS) manual.release(ACTION_KEYS[event.code]);
  });
  window.addEventListener('blur', () => manual.clear());
}

/**
 * Keys on the map: the arrows move a cross, others act at its place.
 * @param {HTMLCanvasElement} canvas
 * @param {() => boolean} isManual arrows drive then
 * @param {(step: number[]) => void} moveCross by whole steps to the right and up
 * @param {Object<string, () => void>} commands by key in lower case
 */
export function listenToCross(canvas, isManual, moveCross, commands) {
  canvas.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || isManual()) return;
    const step = CROSS_KEYS[event.key];
    const command = commands[event.key.toLowerCase()];
    if (step) moveCross(step.map((part) => (event.shiftKey ? 5 * part : part)));
    else if (command) command();
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
}
