"use strict";

// A question appears when all of its media are loaded and the server has recorded this. At that
// moment the server's clock starts.

const page = document.querySelector("main.question");
const form = document.querySelector("main form");
const status = document.getElementById("status");
const video = document.querySelector("video");

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

// Repeat a request until the server responds, because it may be down for a while.
async function fetchUntilAnswered(address, options) {
  for (;;) {
    try {
      const response = await fetch(address, options);
      if (response.status < 500) return response;
    } catch (error) {
      // The server is unreachable: try again, as after a server error.
    }
    status.textContent = "The study cannot be reached. Trying again…";
    await pause(1500);
  }
}

function post(address, fields) {
  return fetchUntilAnswered(address, {
    method: "POST",
    body: new URLSearchParams(fields),
    redirect: "manual",
  });
}

async function load(element) {
  const response = await fetchUntilAnswered(element.dataset.src);
  if (!response.ok) throw new Error("not found");
  const ready = element === video
    ? new Promise((done, failed) => {
        video.addEventListener("loadedmetadata", done, { once: true });
        video.addEventListener("error", failed, { once: true });
      })
    : null;
  element.src = URL.createObjectURL(await response.blob());
  await (ready ?? element.decode());
}

function play() {
  video.currentTime = 0;
  // A browser that saves power may refuse to play; the annotator can use the button.
  video.play().catch(() => {});
}

async function show() {
  try {
    await Promise.all([...page.querySelectorAll("[data-src]")].map(load));
    const response = await post("/loaded", { key: page.dataset.key });
    if (!response.ok) throw new Error("closed");
  } catch (error) {
    status.textContent = "This page is outdated. Please reload it.";
    return;
  }
  status.textContent = "";
  page.classList.remove("loading");
  play();
  form.querySelector("fieldset").disabled = false;
  form.addEventListener("change", () => {
    form.querySelector("button").disabled = false;
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const fields = new FormData(form);
    form.querySelector("fieldset").disabled = true;
    form.querySelector("button").disabled = true;
    await post("/answer", fields);
    location.replace("/");
  });
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  const key = event.key.toUpperCase();
  if (key === "R" && video) {
    play();
  } else if (/^[A-D1-4]$/.test(key) && page) {
    const choice = form.querySelectorAll("input[type=radio]")["ABCD1234".indexOf(key) % 4];
    choice.focus();
    choice.click();
  } else if (key === "ENTER" && form && !event.target.closest("button, a, input")) {
    const button = form.querySelector("button");
    if (!button.disabled) form.requestSubmit(button);
  }
}

document.addEventListener("keydown", onKey);
document.getElementById("replay")?.addEventListener("click", play);
if (page) show();
