"use strict";
// Pictures under a border that moves, any two of a panel against each other, at any exposure. Used by reports and by the live page.
const viewer = (() => {
  const STOPS = 8;
  let stops = 0;

  // What a picture shows when nothing was chosen: `base` is its place, or the data itself, at the page's own exposure.
  const base = (image) => (image.base ??= image.getAttribute("src"));
  const choice = (image) => ({
    label: image.dataset.label, base: base(image), alt: image.alt, linear: "linear" in image.dataset,
  });

  function show(image, what) {
    const served = "served" in image.dataset;
    const source = served && what.linear && stops ? `${what.base}?stops=${stops}` : what.base;
    if (image.getAttribute("src") !== source) image.setAttribute("src", source);
    if (image.alt !== what.alt) image.alt = what.alt;
    image.style.filter = !served && what.linear && stops ? "url(#exposure)" : "";
  }

  // The pictures that a slider may show: its own two, and those beside it.
  function choices(slider) {
    const scope = slider.closest("[data-scope=stack] .stack") ?? slider.closest(".panel") ?? slider.parentElement;
    const found = new Map();
    for (const image of scope.querySelectorAll("img")) {
      const own = image.own ?? choice(image);
      if (own.label && !found.has(own.label)) found.set(own.label, { ...own, base: base(image) });
    }
    return found;
  }

  function picks(slider) {
    const bar = slider.parentElement.querySelector(".picks");
    if (!bar) return;
    const found = [...choices(slider).keys()];
    if (slider.picks && found.join("\n") === slider.picks.found) return;
    bar.replaceChildren();
    slider.picks = { found: found.join("\n") };
    if (found.length < 3) return;
    for (const side of ["left", "right"]) {
      const select = document.createElement("select");
      select.setAttribute("aria-label", `Picture on the ${side}`);
      for (const label of found) select.append(new Option(label, label));
      const wanted = slider.wanted?.[side];
      select.value = found.includes(wanted) ? wanted : slider.querySelector(`img.${side}`).own.label;
      select.addEventListener("change", () => {
        slider.wanted = { ...slider.wanted, [side]: select.value };
        draw(slider);
      });
      slider.picks[side] = select;
      bar.append(select);
    }
  }

  function draw(slider) {
    const found = choices(slider);
    for (const [side, tag] of [["left", ".tag.l"], ["right", ".tag.r"]]) {
      const image = slider.querySelector(`img.${side}`);
      const what = found.get(slider.picks?.[side]?.value) ?? { ...image.own, base: base(image) };
      show(image, what);
      slider.querySelector(tag).textContent = what.label;
      slider[side] = what.label;
    }
    const range = slider.querySelector("input");
    range.setAttribute("aria-label", `${slider.left} on the left, ${slider.right} on the right: move the border`);
    move(slider);
  }

  function move(slider) {
    const range = slider.querySelector("input");
    slider.style.setProperty("--at", `${range.value}%`);
    range.setAttribute("aria-valuetext", `${range.value} percent ${slider.left}`);
  }

  function prepare(slider) {
    if (slider.prepared) return;
    slider.prepared = true;
    for (const image of slider.querySelectorAll("img")) image.own = choice(image);
    const range = slider.querySelector("input");
    const point = (event) => {
      const box = slider.getBoundingClientRect();
      range.value = (100 * (event.clientX - box.left)) / box.width;
      move(slider);
    };
    slider.addEventListener("pointerdown", (event) => {
      slider.setPointerCapture(event.pointerId);
      point(event);
      range.focus({ preventScroll: true });
    });
    slider.addEventListener("pointermove", (event) => {
      if (slider.hasPointerCapture(event.pointerId)) point(event);
    });
    range.addEventListener("input", () => move(slider));
  }

  // After anything has changed: what is new gets its controls, and every picture what was chosen for it.
  function refresh() {
    for (const slider of document.querySelectorAll(".slider")) {
      prepare(slider);
      picks(slider);
      draw(slider);
    }
    for (const image of document.querySelectorAll("figure > img")) show(image, choice(image));
  }

  function expose(range) {
    stops = Math.max(-STOPS, Math.min(STOPS, Number(range.value) || 0));
    for (const output of document.querySelectorAll(".exposure output")) output.textContent = `${stops > 0 ? "+" : ""}${stops} EV`;
    for (const slope of document.querySelectorAll("#exposure *")) slope.setAttribute("slope", 2 ** stops);
    refresh();
  }

  function start() {
    // A filter that multiplies linear colours, for pictures that are part of the page.
    const filter = document.createElement("div");
    filter.className = "filter";
    filter.innerHTML =
      '<svg width="0" height="0" aria-hidden="true"><filter id="exposure" color-interpolation-filters="linearRGB"><feComponentTransfer>' +
      "RGB".replace(/./g, '<feFunc$& type="linear" slope="1"/>') + "</feComponentTransfer></filter></svg>";
    document.body.append(filter);
    for (const range of document.querySelectorAll(".exposure input")) {
      range.closest(".exposure").hidden = false;
      range.addEventListener("input", () => expose(range));
    }
    for (const select of document.querySelectorAll("select.view")) {
      const panels = [...document.querySelectorAll("[data-view]")];
      const one = () => panels.forEach((panel) => (panel.hidden = panel.dataset.view !== select.value));
      select.closest("label").hidden = false;
      select.addEventListener("change", one);
      one();
    }
    refresh();
  }

  return { base, refresh, start };
})();
viewer.start();
