"use strict";
// Draws the panels of a film into the layers of the comparison, and plays it; to be run before compare.js.
(() => {
  const byId = (id) => document.getElementById(id);
  const stage = byId("stage"), film = byId("film"), scrubber = byId("frame-number"), shown = byId("frame-shown");
  const play = byId("play"), player = stage.parentElement;
  const fps = Number(film.dataset.fps), count = Number(film.dataset.count);
  const layers = [...stage.querySelectorAll("canvas")].map((canvas) => {
    const [x, y] = ["x", "y"].map((side) => Number(canvas.dataset[side]));
    return { canvas, x, y, context: canvas.getContext("2d") };
  });

  const draw = (time) => {
    if (film.readyState < 2) return;
    for (const { canvas, x, y, context } of layers) {
      const { width, height } = canvas;
      if (getComputedStyle(canvas).visibility !== "hidden") context.drawImage(film, x, y, width, height, 0, 0, width, height);
    }
    const number = Math.min(Math.floor(time * fps + 0.01), count - 1);
    scrubber.value = String(number);
    shown.textContent = String(number);
  };
  const drawNow = () => draw(film.currentTime);
  // The callback tells the time of the frame that is seen; without it the time of the player is near enough.  Where the
  // film stands still the callback may be late, and tell of a frame before.
  const seen = (frame) => { if (!film.seeking) draw(film.paused ? film.currentTime : frame.mediaTime); };
  const follow = film.requestVideoFrameCallback
    ? () => film.requestVideoFrameCallback((_, frame) => { seen(frame); follow(); })
    : () => requestAnimationFrame(() => { if (!film.paused) drawNow(); if (film.isConnected) follow(); });

  // The middle of a frame, where no rounding leads to its neighbour.
  const show = (number) => {
    film.pause();
    film.currentTime = (Math.min(Math.max(number, 0), count - 1) + 0.5) / fps;
  };
  const step = (by) => show((Number(scrubber.value) + by + count) % count);
  const toggle = () => film.paused ? film.play() : film.pause();
  const KEYS = { " ": toggle, ",": () => step(-1), ".": () => step(1), Home: () => show(0), End: () => show(count - 1) };
  player.addEventListener("keydown", (event) => {
    // Of buttons and lists the space bar is their own, of sliders Home and End too.
    const own = event.target !== stage && (event.key === " " || event.key.length > 1);
    if (!KEYS[event.key] || own || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    KEYS[event.key]();
  });
  play.addEventListener("click", toggle);
  byId("previous").addEventListener("click", () => step(-1));
  byId("next").addEventListener("click", () => step(1));
  scrubber.addEventListener("input", () => show(Number(scrubber.value)));
  byId("speed").addEventListener("change", (event) => { film.playbackRate = Number(event.target.value); });
  for (const name of ["play", "pause"]) {
    film.addEventListener(name, () => { play.textContent = film.paused ? "Play" : "Pause"; });
  }
  film.addEventListener("seeked", drawNow);
  film.addEventListener("loadeddata", drawNow);
  for (const id of ["left", "right"]) byId(id).addEventListener("change", () => requestAnimationFrame(drawNow));

  film.controls = false;
  film.tabIndex = -1;
  film.classList.add("unseen");
  stage.hidden = byId("playback").hidden = false;
  follow();
  drawNow();
})();
