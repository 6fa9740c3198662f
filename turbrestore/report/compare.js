
"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  // The app replaces the page's comparison while this one still observes its stage, so every part is looked up once.
  const stage = byId("stage"), line = byId("line"), divider = byId("divider"), zoom = byId("zoom");
  const zoomIn = byId("in"), zoomOut = byId("out"), stretch = byId("stretch");
  const selects = { left: byId("left"), right: byId("right") };
  const layers = [...stage.querySelectorAll(".layer")];
  const images = layers.map((layer) => layer.querySelector("img, canvas"));
  // The property would be the width on the page.
  const [width, height] = ["width", "height"].map((name) => Number(images[0].getAttribute(name)));
  const LARGEST = 32, STEP = 1.25, REACH = 18, NUDGE = 40;
  let scale = 1, x = 0, y = 0, fitted = true;

  const fitScale = () => Math.min(stage.clientWidth / width, stage.clientHeight / height);
  const smallest = () => Math.min(fitScale(), 1);
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
  // An image smaller than the stage stays in its middle, a larger one covers it.
  const place = (offset, room, size) => size <= room ? (room - size) / 2 : clamp(offset, room - size, 0);
  // The divider runs over what is seen of the image: where that begins, and how long it is.
  const seen = () => {
    const start = Math.max(x, 0);
    return [start, Math.min(x + width * scale, stage.clientWidth) - start];
  };
  const border = () => {
    const [start, length] = seen();
    return start + length * Number(divider.value) / 100;
  };
  const overflows = () => width * scale > stage.clientWidth + 1 || height * scale > stage.clientHeight + 1;

  const draw = () => {
    x = place(x, stage.clientWidth, width * scale);
    y = place(y, stage.clientHeight, height * scale);
    for (const image of images) image.style.transform = `translate(${x}px, ${y}px) scale(${scale})`;
    stage.classList.toggle("large", scale >= 2);
    stage.classList.toggle("zoomed", overflows());
    zoom.textContent = `${Math.round(100 * scale)} %`;
    zoomIn.disabled = scale >= LARGEST;
    zoomOut.disabled = scale <= smallest() * 1.001;
    split();
  };

  const split = () => {
    const share = Number(divider.value), place = border();
    const same = selects.left.value === selects.right.value;
    for (const layer of layers) {
      const left = layer.dataset.key === selects.left.value;
      layer.classList.toggle("left", left);
      layer.classList.toggle("right", layer.dataset.key === selects.right.value);
      layer.style.clipPath = left && !same ? `inset(0 ${stage.clientWidth - place}px 0 0)` : "";
    }
    line.style.left = `${place}px`;
    const name = (select) => select.selectedOptions[0].text;
    const text = `${name(selects.left)} on the left ${share} %, ${name(selects.right)} on the rest`;
    divider.setAttribute("aria-valuetext", text);
  };

  // Keep the point (px, py) of the stage where it is.
  const zoomTo = (wanted, px = stage.clientWidth / 2, py = stage.clientHeight / 2) => {
    const next = clamp(wanted, smallest(), LARGEST);
    x = px - (px - x) * next / scale;
    y = py - (py - y) * next / scale;
    scale = next;
    fitted = false;
    draw();
  };
  const fit = () => { scale = fitScale(); fitted = true; draw(); };
  const moveDivider = (share) => { divider.value = String(Math.round(clamp(share, 0, 100))); split(); };
  const moveBorder = (px) => {
    const [start, length] = seen();
    moveDivider(100 * (px - start) / length);
  };

  const held = { pointer: null, what: "", lastX: 0, lastY: 0 };
  const inside = (event) => {
    const box = stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || held.pointer !== null) return;
    const [px, py] = inside(event);
    const near = Math.abs(px - border()) < REACH;
    Object.assign(held, { pointer: event.pointerId, what: near || !overflows() ? "divider" : "image", lastX: px, lastY: py });
    stage.setPointerCapture(event.pointerId);
    stage.classList.toggle("held", held.what === "image");
    if (held.what === "divider") moveBorder(px);
  });
  stage.addEventListener("pointermove", (event) => {
    if (event.pointerId !== held.pointer) return;
    const [px, py] = inside(event);
    if (held.what === "divider") {
      moveBorder(px);
    } else {
      x += px - held.lastX;
      y += py - held.lastY;
      draw();
    }
    Object.assign(held, { lastX: px, lastY: py });
  });
  const release = (event) => {
    if (event.pointerId !== held.pointer) return;
    held.pointer = null;
    stage.classList.remove("held");
  };
  stage.addEventListener("pointerup", release);
  stage.addEventListener("pointercancel", release);
  // A wheel alone scrolls the page; with Ctrl, which is also what pinching sends, it zooms.
  stage.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoomTo(scale * Math.exp(-event.deltaY / 300), ...inside(event));
  }, { passive: false });

  const pan = (dx, dy) => {
    if (overflows()) { x += dx; y += dy; draw(); } else if (dx) { moveDivider(Number(divider.value) - Math.sign(dx)); }
  };
  const KEYS = {
    ArrowLeft: () => pan(NUDGE, 0),
    ArrowRight: () => pan(-NUDGE, 0),
    ArrowUp: () => pan(0, NUDGE),
    ArrowDown: () => pan(0, -NUDGE),
    "+": () => zoomTo(scale * STEP),
    "=": () => zoomTo(scale * STEP),
    "-": () => zoomTo(scale / STEP),
    "0": fit,
    "1": () => zoomTo(1),
  };
  stage.addEventListener("keydown", (event) => {
    const vertical = event.key === "ArrowUp" || event.key === "ArrowDown";
    if (!KEYS[event.key] || event.ctrlKey || event.metaKey || event.altKey || (vertical && !overflows())) return;
    event.preventDefault();
    KEYS[event.key]();
  });

  const showStretch = () => stage.classList.toggle("stretched", stretch.checked);
  stretch.addEventListener("change", showStretch);
  divider.addEventListener("input", split);
  for (const select of Object.values(selects)) select.addEventListener("change", split);
  zoomIn.addEventListener("click", () => zoomTo(scale * STEP));
  zoomOut.addEventListener("click", () => zoomTo(scale / STEP));
  byId("fit").addEventListener("click", fit);
  byId("actual").addEventListener("click", () => zoomTo(1));

  stage.classList.add("live");
  stage.style.aspectRatio = `${width} / ${height}`;
  stage.tabIndex = 0;
  stage.setAttribute("role", "group");
  stage.setAttribute("aria-label", "Two images, split by the divider. Plus and minus zoom, arrows pan, 0 fits.");
  for (const part of [line, byId("choice"), byId("view")]) part.hidden = false;
  showStretch();
  new ResizeObserver(() => fitted ? fit() : draw()).observe(stage);
  fit();
})();
