"use strict";

// Responses of models are set as text, never as markup.
const { items, frames } = JSON.parse(document.getElementById("data").textContent);
const PER_PAGE = 10;
const ANY = "any";
const form = document.getElementById("filters");
const list = document.getElementById("list");
const more = document.getElementById("more");
let matching = [];

function element(tag, className, text) {
  const created = document.createElement(tag);
  if (className) created.className = className;
  if (text !== undefined) created.textContent = text;
  return created;
}

function distinct(values) {
  return [...new Set(values)].sort();
}

function fillOptions(name, values) {
  const select = form.elements[name];
  const previous = select.value;
  select.replaceChildren(
    ...[ANY, ...values].map((value) => {
      const option = element("option", "", value);
      option.value = value;
      return option;
    }),
  );
  select.value = values.includes(previous) ? previous : ANY;
}

function passes(value, name) {
  const wanted = form.elements[name].value;
  return wanted === ANY || wanted === value;
}

function fillSubtypes() {
  const ofFamily = items.filter((item) => passes(item.family, "family"));
  fillOptions("subtype", distinct(ofFamily.map((item) => item.subtype)));
}

function visibleResponses(item) {
  return item.responses.filter((response) => passes(response.model, "model"));
}

function matches(item) {
  return (
    passes(item.benchmark, "benchmark") &&
    passes(item.family, "family") &&
    passes(item.subtype, "subtype") &&
    visibleResponses(item).some((response) => passes(response.verdict, "verdict"))
  );
}

function frameFigure(name, caption, className) {
  const figure = element("figure", className);
  if (frames[name]) {
    const image = element("img");
    image.src = frames[name];
    image.alt = caption;
    figure.append(image);
  } else {
    figure.append(element("div", "gone", "frame is missing"));
  }
  figure.append(element("figcaption", "", caption));
  return figure;
}

// The text of a response, with a mark around the words of each claim.
function markedText(response) {
  const text = element("pre");
  // Positions count characters, of which some have two code units.
  const characters = Array.from(response.text);
  const between = (start, stop) => characters.slice(start, stop).join("");
  let end = 0;
  for (const { start, stop, verdict, title } of response.claims) {
    const mark = element("mark", verdict, between(start, stop));
    mark.title = title;
    text.append(between(end, start), mark);
    end = stop;
  }
  text.append(between(end, characters.length));
  return text;
}

function responseBlock(response) {
  const { letter, verdict, reason } = response;
  const block = element("div", "answer");
  const head = element("div");
  head.append(
    element("span", "", `${response.model}: `),
    element("span", `verdict ${verdict}`, letter ? `${letter}, ${verdict}` : `no letter (${reason})`),
  );
  if (response.truncated) head.append(element("span", "", " (truncated)"));
  block.append(head, markedText(response));
  return block;
}

// The facts of the oracle, folded.
function factList(facts) {
  const folded = element("details", "facts");
  const entries = element("ul");
  entries.append(...facts.map((fact) => element("li", "", fact)));
  folded.append(element("summary", "", "Facts of the oracle"), entries);
  return folded;
}

function itemArticle(item) {
  const article = element("article");
  article.dataset.id = item.id;
  article.append(
    element("h3", "", `${item.family}, ${item.subtype}`),
    element("div", "note", `${item.id}, ${item.benchmark}`),
    element("p", "", item.question),
    element("div", "note", `Observed: ${item.observed}`),
  );
  const prefix = element("div", "frames");
  prefix.append(...item.prefix.map((name) => frameFigure(name, `frame ${name.split("/").pop()}`)));
  const candidates = element("div", "frames candidates");
  candidates.append(
    ...item.candidates.map((c) =>
      frameFigure(c.frame, `${c.letter}: ${c.caption}`, c.letter === item.answer ? "target" : ""),
    ),
  );
  article.append(prefix, element("div", "note", "Candidates (the target is framed):"), candidates);
  article.append(...item.truth.map((sentence) => element("p", "truth", sentence)));
  if (item.facts.length) article.append(factList(item.facts));
  article.append(...visibleResponses(item).map(responseBlock));
  return article;
}

function showMore() {
  const begin = list.childElementCount;
  list.append(...matching.slice(begin, begin + PER_PAGE).map(itemArticle));
  more.hidden = list.childElementCount >= matching.length;
}

function show() {
  matching = items.filter(matches);
  document.getElementById("count").textContent = `${matching.length} of ${items.length} items`;
  list.replaceChildren();
  showMore();
}

const responses = items.flatMap((item) => item.responses);
fillOptions("benchmark", distinct(items.map((item) => item.benchmark)));
fillOptions("family", distinct(items.map((item) => item.family)));
fillOptions("model", distinct(responses.map((response) => response.model)));
fillOptions("verdict", distinct(responses.map((response) => response.verdict)));
fillSubtypes();
form.addEventListener("change", (event) => {
  if (event.target.name === "family") fillSubtypes();
  show();
});
form.addEventListener("submit", (event) => event.preventDefault());
more.addEventListener("click", () => {
  const begin = list.childElementCount;
  showMore();
  // Keyboard focus moves to the first new item.
  const next = list.children[begin];
  next.tabIndex = -1;
  next.focus();
});
show();
