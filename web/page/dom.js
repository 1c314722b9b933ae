// @ts-check
// Elements of the page, and short helpers.

/** @type {(id: string) => any} */
export const $ = id => document.getElementById(id);
/** Makes an element, in a parent if given. @type {(name: string, text?: string, parent?: Element | null, more?: Record<string, any>) => any} */
export const make = (name, text = "", parent = null, more = {}) => {
  const element = Object.assign(document.createElement(name), more);
  if (text !== "") element.textContent = text;
  if (parent) parent.append(element);
  return element;
};
/** @type {(selector: string, within?: ParentNode) => any} */
export const find = (selector, within = document) => within.querySelector(selector);
/** @type {(selector: string) => any[]} */
export const all = selector => [...document.querySelectorAll(selector)];
/** Returns what draws on a canvas. @param {HTMLCanvasElement} canvas */
export const pen_of = canvas => /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
export const still = matchMedia("(prefers-reduced-motion: reduce)");
/** @param {number} value */
export const number = value => String(Number(value.toFixed(3)));
/** @param {number} many @param {string} what */
export const count = (many, what) => `${many} ${what}${many === 1 ? "" : "s"}`;

/** Shows an error, or none. @param {string} message */
export function trouble(message) {
  $("trouble").textContent = message;
  $("trouble").hidden = !message;
}

/** Saves a file. @param {string} name @param {BlobPart} content @param {string} type */
export function save(name, content, type) {
  const link = make("a", "", document.body, { href: URL.createObjectURL(new Blob([content], { type })), download: name });
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  $("said").textContent = `${name} is saved.`;
}

/** Copies a text, and then says so. @param {string} text @param {string} said */
export async function copy(text, said) {
  try {
    await navigator.clipboard.writeText(text);
    $("said").textContent = said;
  } catch { $("said").textContent = `This browser does not let a page copy. Here it is: ${text}`; }
}
