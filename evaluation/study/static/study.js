"use strict";

// A question is shown at once, when all of it is there and the server knows: both clocks begin then.

const page = document.querySelector("main.question");
const form = document.querySelector("main form");
const status = document.getElementById("status");
const video = document.querySelector("video");

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

// Ask until there is an answer: the server may be away for a while.
async function persist(address, options) {
  for (;;) {
    try {
      const response = await fetch(address, options);
      if (response.status < 500) return response;
    } catch (error) {
      // Unreachable, like a server that is in trouble.
    }
    status.textContent = "The study cannot be reached. Trying again…";
    await pause(1500);
  }
}

function post(address, fields) {
  return persist(address, {
    method: "POST",
    body: new URLSearchParams(fields),
    redirect: "manual",
  });
}

async function load(element) {
  const response = await persist(element.dataset.src);
  if (!response.ok) throw new Error("gone");
  const there = element === video
    ? new Promise((done, failed) => {
        video.addEventListener("loadedmetadata", done, { once: true });
        video.addEventListener("error", failed, { once: true });
      })
    : null;
  element.src = URL.createObjectURL(await response.blob());
  await (there ?? element.decode());
}

function play() {
  video.currentTime = 0;
  // Refused by a browser that saves power: the button is there.
  video.play().catch(() => {});
}

async function show() {
  const asked = "asked" in page.dataset;
  try {
    await Promise.all([...page.querySelectorAll("[data-src]")].map(load));
    if (asked) {
      const fields = { key: page.dataset.key, form_key: page.dataset.formKey };
      const response = await post("/loaded", fields);
      if (!response.ok) throw new Error("over");
    }
  } catch (error) {
    status.textContent = "This page is not the one to answer any more. Load it again, please.";
    return;
  }
  const since = performance.now();
  status.textContent = "";
  page.classList.remove("loading");
  play();
  if (asked) answer(since);
}

function answer(since) {
  form.querySelector("fieldset").disabled = false;
  form.addEventListener("change", () => {
    form.querySelector("button").disabled = false;
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    form.elements.seconds.value = ((performance.now() - since) / 1000).toFixed(3);
    const fields = new FormData(form);
    form.querySelector("fieldset").disabled = true;
    form.querySelector("button").disabled = true;
    await post("/answer", fields);
    location.replace("/");
  });
}

function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  const key = event.key.toUpperCase();
  if (key === "R" && video) {
    play();
  } else if (/^[A-D1-4]$/.test(key) && page && "asked" in page.dataset) {
    const choice = form.querySelectorAll("input[type=radio]")["ABCD1234".indexOf(key) % 4];
    choice.focus();
    choice.click();
  } else if (key === "ENTER" && form && !event.target.closest("button, a, input")) {
    const button = form.querySelector("button");
    if (!button.disabled) form.requestSubmit(button);
  }
}

document.addEventListener("keydown", pressed);
document.getElementById("replay")?.addEventListener("click", play);
if (page) show();
