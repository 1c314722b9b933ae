// @ts-check
// Elements of the page, and short helpers.

/** @type {(id: string) => any} */
export const $ = id => document.getElementById(id);
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
export const still = matchMedia("(prefers-reduced-motion: reduce)");
export const number = value => String(Number(value.toFixed(3)));
export const count = (many, what) => `${many} ${what}${many === 1 ? "" : "s"}`;

export function trouble(message) {
  $("trouble").textContent = message;
  $("trouble").hidden = !message;
}

export function save(name, content, type) {
  const link = make("a", "", document.body, { href: URL.createObjectURL(new Blob([content], { type })), download: name });
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  $("said").textContent = `${name} is saved.`;
}

export async function copy(text, said) {
  try {
    await navigator.clipboard.writeText(text);
    $("said").textContent = said;
  } catch { $("said").textContent = `This browser does not let a page copy. Here it is: ${text}`; }
}
