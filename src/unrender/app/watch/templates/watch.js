"use strict";
// Asks for what has changed, and takes it over without touching what the reader has chosen, focused or moved.
(() => {
  // Between two questions, in milliseconds; and how many times as long as the last answer took, here and there, one waits at least: where
  // processors are few, the run needs them more.
  const EVERY = 1000;
  const SELDOM = 5000;
  const SHARE = 50;
  const SIZE = ["width", "height"];
  const live = document.getElementById("live");
  const link = document.getElementById("link");
  const picked = { run: 0, view: 0 };
  let seen = "";
  let timer = 0;
  let asking = null;

  function attributes(old, fresh) {
    for (const { name, value } of [...fresh.attributes]) {
      if (name === "src") {
        old.getAttribute("src") ?? old.setAttribute("src", value);
        old.base = value;
      } else if (old.getAttribute(name) !== value) old.setAttribute(name, value);
    }
    for (const { name } of [...old.attributes]) {
      if (!fresh.hasAttribute(name) && name !== "src") old.removeAttribute(name);
    }
  }

  // Of a slider only the two pictures change; its border, labels and choices are the reader's.
  function slider(old, fresh) {
    for (const side of ["left", "right"]) {
      const [image, now] = [old, fresh].map((one) => one.querySelector(`img.${side}`));
      const own = image.own?.label ?? image.dataset.label;
      if (own !== now.dataset.label || SIZE.some((name) => image.getAttribute(name) !== now.getAttribute(name))) return false;
    }
    for (const side of ["left", "right"]) {
      const [image, now] = [old, fresh].map((one) => one.querySelector(`img.${side}`));
      image.base = now.getAttribute("src");
      image.own = { ...image.own, alt: now.alt };
    }
    return true;
  }

  function take(old, fresh) {
    if (old.nodeType !== fresh.nodeType || old.nodeName !== fresh.nodeName) return old.replaceWith(fresh);
    if (old.nodeType === Node.TEXT_NODE) {
      if (old.nodeValue !== fresh.nodeValue) old.nodeValue = fresh.nodeValue;
      return;
    }
    if (old.nodeType !== Node.ELEMENT_NODE || "keep" in old.dataset) return;
    if (old.classList.contains("slider")) {
      if (!slider(old, fresh)) old.replaceWith(fresh);
      return;
    }
    if (old.nodeName === "SELECT") return options(old, fresh);
    if (old.nodeName === "INPUT") return;
    attributes(old, fresh);
    const [had, have] = [[...old.childNodes], [...fresh.childNodes]];
    have.forEach((node, i) => (had[i] ? take(had[i], node) : old.append(node)));
    had.slice(have.length).forEach((node) => node.remove());
  }

  function options(old, fresh) {
    const list = (select) => [...select.options].map((option) => option.value + option.text).join("\n");
    if (list(old) === list(fresh)) return;
    const { value } = old;
    old.replaceChildren(...fresh.children);
    if ([...old.options].some((option) => option.value === value)) old.value = value;
  }

  async function ask() {
    clearTimeout(timer);
    asking?.abort();
    const mine = (asking = new AbortController());
    let wait = EVERY;
    try {
      const query = new URLSearchParams({ ...picked, seen });
      const answer = await fetch(`update?${query}`, { signal: mine.signal, cache: "no-store" });
      if (answer.status === 200) {
        const text = await answer.text();
        const began = performance.now();
        seen = answer.headers.get("x-digest") ?? "";
        // Parsed apart, where nothing runs; text stays text, for the server has escaped it.
        const fresh = new DOMParser().parseFromString(text, "text/html").getElementById("live");
        if (fresh) take(live, document.importNode(fresh, true));
        viewer.refresh();
        const took = performance.now() - began + Number(answer.headers.get("x-milliseconds"));
        wait = Math.min(Math.max(EVERY, SHARE * took), SELDOM);
      }
      if (answer.status === 403) {
        link.textContent = "This page's address is no longer valid: the server has been started anew.";
        return;
      }
      if (!answer.ok && answer.status !== 204) throw new Error(String(answer.status));
      link.textContent = "";
      if (!live.querySelector("[data-state=running], [data-state=paused], [data-state=waiting], [data-state=saving]")) wait = SELDOM;
    } catch (error) {
      if (error.name === "AbortError") return;
      link.textContent = "The server does not answer: this is what was last known.";
      wait = SELDOM;
    }
    if (!document.hidden) timer = setTimeout(ask, wait);
  }

  live.addEventListener("click", async (event) => {
    const button = event.target.closest("button[data-command]");
    if (!button) return;
    const { command } = button.dataset;
    const run = button.closest("[data-run]").dataset.run;
    if (command === "stop" && !confirm("Stop this run? Its results are saved.")) return;
    const answer = await fetch(`control/${run}`, {
      method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ command }),
    }).catch(() => null);
    if (!answer?.ok) link.textContent = answer ? await answer.text() : "The server does not answer.";
    setTimeout(ask, 250);
  });
  live.addEventListener("change", (event) => {
    const what = event.target.dataset.pick;
    if (!what) return;
    picked[what] = Number(event.target.value);
    ask();
  });
  document.addEventListener("visibilitychange", () => (document.hidden ? clearTimeout(timer) : ask()));
  ask();
})();
