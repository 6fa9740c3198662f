"use strict";
// What the page does in the browser itself; mountCompare is the script of the report.
window.turbrestore = (() => {
  const byId = (id) => document.getElementById(id);
  const ENDS = ["left", "right", "divider"];
  const kept = () => Object.fromEntries(ENDS.map((id) => [id, byId(id)?.value]));
  const restore = (values) => {
    for (const id of ENDS) {
      const element = byId(id), known = [...(element.options ?? [])].map((option) => option.value);
      if (values[id] === undefined || (element.options && !known.includes(values[id]))) continue;
      element.value = values[id];
      element.dispatchEvent(new Event(element.options ? "change" : "input"));
    }
  };
  return {
    // Show other images; the divider stays where it is.  The newest stage goes to the right.
    compare(markup) {
      const values = kept();
      delete values.right;
      byId("compare").innerHTML = markup;
      mountCompare();
      restore(values);
    },
    // Exchange one image for another of its size.
    async replace(key, address) {
      const next = new Image();
      next.src = address;
      await next.decode();
      const shown = document.querySelector(`#stage .layer[data-key="${key}"] img`);
      if (shown) shown.src = address;
    },
    // Middle of what is seen, as shares of the image.
    middle() {
      const stage = byId("stage"), image = stage?.querySelector(".layer.right img");
      if (!image?.offsetWidth) return [0.5, 0.5];
      const frame = stage.getBoundingClientRect(), box = image.getBoundingClientRect();
      return [(frame.x + frame.width / 2 - box.x) / box.width, (frame.y + frame.height / 2 - box.y) / box.height];
    },
  };
})();
