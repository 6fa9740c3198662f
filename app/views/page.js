"use strict";
// What the page does in the browser itself; mountCompare and mountFilm are scripts of the report.
document.documentElement.lang = "en";
window.turbrestore = (() => {
  const byId = (id) => document.getElementById(id);
  const CONTROLS = ["left", "right", "divider", "stretch"];
  // The comparison of images and that of a film have parts of the same names, so only the one that is looked at exists.
  const markups = { compare: "", video: "" }, values = { compare: {}, video: {} };
  let mounted = null;

  const keep = () => {
    for (const id of CONTROLS) {
      const element = byId(id);
      if (element) values[mounted][id] = element.type === "checkbox" ? element.checked : element.value;
    }
  };
  const restore = (known) => {
    for (const id of CONTROLS) {
      const element = byId(id), value = known[id];
      if (!element || value === undefined) continue;
      if (element.options && ![...element.options].some((option) => option.value === value)) continue;
      if (element.type === "checkbox") element.checked = value; else element.value = value;
      element.dispatchEvent(new Event(element.type === "range" ? "input" : "change"));
    }
  };
  const unmount = () => {
    if (!mounted) return;
    keep();
    byId(mounted).replaceChildren();
    mounted = null;
  };
  const mount = (place) => {
    unmount();
    if (!markups[place]) return;
    byId(place).innerHTML = markups[place];
    mounted = place;
    if (place === "video") mountFilm();
    mountCompare();
    restore(values[place]);
  };
  return {
    // Show other images or another film; the divider stays where it is.  The newest stage goes to the right.
    fill(place, markup) {
      if (mounted === place) unmount();
      markups[place] = markup;
      delete values[place].right;
      if (byId(place).offsetParent) mount(place);
    },
    look(place) {
      if (place in markups) { if (mounted !== place) mount(place); } else { unmount(); }
    },
    // Exchange one image for another of its size.
    async replace(key, address) {
      const next = new Image();
      next.src = address;
      // A newer image has replaced it already where the server no longer has it.
      if (!await next.decode().then(() => true, () => false)) return;
      const shown = document.querySelector(`#compare .layer[data-key="${key}"] img`);
      if (!shown) return;
      markups.compare = markups.compare.replace(shown.getAttribute("src"), address);
      shown.src = address;
    },
    // Middle of what is seen, as shares of the image.
    middle() {
      const stage = byId("stage"), image = stage?.querySelector(".layer.right img");
      if (!image?.offsetWidth) return [0.5, 0.5];
      const frame = stage.getBoundingClientRect(), box = image.getBoundingClientRect();
      return [(frame.x + frame.width / 2 - box.x) / box.width, (frame.y + frame.height / 2 - box.y) / box.height];
    },
    // The whole page takes files that are dropped.
    acceptDrops(upload) {
      const app = document.querySelector(".app");
      const holdsFiles = (event) => event.dataTransfer?.types.includes("Files");
      let depth = 0;
      const enter = (by) => { depth = Math.max(depth + by, 0); app.classList.toggle("dropping", depth > 0); };
      document.addEventListener("dragenter", (event) => { if (holdsFiles(event)) enter(1); });
      document.addEventListener("dragleave", (event) => { if (holdsFiles(event)) enter(-1); });
      document.addEventListener("dragover", (event) => { if (holdsFiles(event)) event.preventDefault(); });
      document.addEventListener("drop", (event) => {
        if (!holdsFiles(event)) return;
        event.preventDefault();
        depth = 0;
        enter(0);
        getElement(upload).$refs.qRef.addFiles([...event.dataTransfer.files]);
      });
    },
  };
})();
