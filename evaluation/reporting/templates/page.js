"use strict";

// Everything that a model said is set as text, never as markup.
const { items, frames } = JSON.parse(document.getElementById("data").textContent);
const PER_PAGE = 10;
const ANY = "any";
const form = document.getElementById("filters");
const list = document.getElementById("list");
const more = document.getElementById("more");
let found = [];

function made(tag, className, text) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  return element;
}

function distinct(values) {
  return [...new Set(values)].sort();
}

function fill(name, values) {
  const select = form.elements[name];
  const before = select.value;
  select.replaceChildren(
    ...[ANY, ...values].map((value) => {
      const option = made("option", "", value);
      option.value = value;
      return option;
    }),
  );
  select.value = values.includes(before) ? before : ANY;
}

function fits(value, name) {
  const wanted = form.elements[name].value;
  return wanted === ANY || wanted === value;
}

function fillSubtypes() {
  const of = items.filter((item) => fits(item.family, "family"));
  fill("subtype", distinct(of.map((item) => item.subtype)));
}

function answersShown(item) {
  return item.said.filter((said) => fits(said.by, "by"));
}

function matches(item) {
  return (
    fits(item.benchmark, "benchmark") &&
    fits(item.family, "family") &&
    fits(item.subtype, "subtype") &&
    answersShown(item).some((said) => fits(said.verdict, "verdict"))
  );
}

function picture(name, caption, className) {
  const figure = made("figure", className);
  if (frames[name]) {
    const image = made("img");
    image.src = frames[name];
    image.alt = caption;
    figure.append(image);
  } else {
    figure.append(made("div", "gone", "frame is missing"));
  }
  figure.append(made("figcaption", "", caption));
  return figure;
}

function answer(said) {
  const block = made("div", "answer");
  const verdict = said.letter ? `${said.letter}, ${said.verdict}` : `no letter (${said.reason})`;
  const head = made("div");
  head.append(made("span", "", `${said.by}: `), made("span", `verdict ${said.verdict}`, verdict));
  if (said.cut) head.append(made("span", "", " (stopped before its end)"));
  block.append(head, made("pre", "", said.text));
  return block;
}

function drawn(item) {
  const article = made("article");
  article.dataset.id = item.id;
  article.append(
    made("h3", "", `${item.family}, ${item.subtype}`),
    made("div", "note", `${item.id}, ${item.benchmark}`),
    made("p", "", item.question),
    made("div", "note", `Observed: ${item.observed}`),
  );
  const prefix = made("div", "frames");
  prefix.append(...item.prefix.map((name) => picture(name, `frame ${name.split("/").pop()}`)));
  const candidates = made("div", "frames candidates");
  candidates.append(
    ...item.candidates.map((c) =>
      picture(c.frame, `${c.letter}: ${c.told}`, c.letter === item.answer ? "target" : ""),
    ),
  );
  article.append(prefix, made("div", "note", "Candidates, the right one framed:"), candidates);
  article.append(...item.truth.map((sentence) => made("p", "truth", sentence)));
  article.append(...answersShown(item).map(answer));
  return article;
}

function showMore() {
  const begin = list.childElementCount;
  list.append(...found.slice(begin, begin + PER_PAGE).map(drawn));
  more.hidden = list.childElementCount >= found.length;
}

function show() {
  found = items.filter(matches);
  document.getElementById("count").textContent = `${found.length} of ${items.length} items`;
  list.replaceChildren();
  showMore();
}

fill("benchmark", distinct(items.map((item) => item.benchmark)));
fill("family", distinct(items.map((item) => item.family)));
fill("by", distinct(items.flatMap((item) => item.said.map((said) => said.by))));
fill("verdict", distinct(items.flatMap((item) => item.said.map((said) => said.verdict))));
fillSubtypes();
form.addEventListener("change", (event) => {
  if (event.target.name === "family") fillSubtypes();
  show();
});
form.addEventListener("submit", (event) => event.preventDefault());
more.addEventListener("click", () => {
  const begin = list.childElementCount;
  showMore();
  // Whoever goes by keyboard goes on at the first new item.
  const next = list.children[begin];
  next.tabIndex = -1;
  next.focus();
});
show();
