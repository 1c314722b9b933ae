// Elements of the page, and short helpers.

/** Returns the element with an id. @template {keyof Elements} K @param {K} id */
export const $ = id => /** @type {Elements[K]} */ (/** @type {unknown} */ (document.getElementById(id)));
/**
 * Makes an element, in a parent if given.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} name @param {string} [text] @param {Element | null} [parent] @param {Partial<HTMLElementTagNameMap[K]>} [more]
 */
export function make(name, text = "", parent = null, more = {}) {
  const element = Object.assign(document.createElement(name), more);
  if (text !== "") element.textContent = text;
  if (parent) parent.append(element);
  return element;
}
/** Makes the key of a line as it is drawn. @param {string} tone @param {number[]} dashes @param {Element} parent */
export function make_key(tone, dashes, parent) {
  const key = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  key.setAttribute("class", "key");
  key.innerHTML = `<line x2="34" y1="4" y2="4" stroke-dasharray="${dashes.join(" ")}"/>`;
  key.style.color = `var(${tone})`;
  parent.append(key);
}
/** Returns all elements that a selector matches. @type {(selector: string, within?: ParentNode) => HTMLElement[]} */
export const all = (selector, within = document) => [...within.querySelectorAll(selector)].filter(element => element instanceof HTMLElement);
/** Returns an option of a list. @param {HTMLSelectElement} list @param {string} value */
export const option = (list, value) => [...list.options].find(({ value: own }) => own === value) ?? new Option();
/** Returns what draws on a canvas. @param {HTMLCanvasElement} canvas @param {CanvasRenderingContext2DSettings} [settings] */
export const pen_of = (canvas, settings) => /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", settings));
export const still = matchMedia("(prefers-reduced-motion: reduce)");
/** @param {number} value */
export const number = value => String(Number(value.toFixed(3)));
/** @param {number} many @param {string} what */
export const count = (many, what) => `${many} ${what}${many === 1 ? "" : "s"}`;
/** Why a worker did not answer: problems of the config, or the worker is lost (`fatal`) or was stopped. */
export class Failure extends Error {
  /** @param {string} message @param {{ problems?: Problem[], fatal?: boolean, stopped?: boolean }} [more] */
  constructor(message, { problems = [], fatal = false, stopped = false } = {}) {
    super(message);
    this.problems = problems;
    this.fatal = fatal;
    this.stopped = stopped;
  }
}
/** Returns what was thrown as a failure. @param {unknown} thrown */
export const failure = thrown => thrown instanceof Failure ? thrown : new Failure(thrown instanceof Error ? thrown.message : String(thrown));

/** Writes a text if it differs. Even the same text would cost a layout. @param {HTMLElement} element @param {string} text */
export function write_text(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
