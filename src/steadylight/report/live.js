"use strict";
// The live page: asks for the state of the run every two seconds, and for few pictures, so that the render keeps the cores.
(() => {
  const $ = id => document.getElementById(id);
  const STAGES = { prepare: "#8f5b34", look: "#d9a441", gather: "#b5791c", merge: "#7a4fa3", audit: "#3f6fb5", fill: "#58a0d0", smooth: "#8a93a0", shade: "#0b7a75", aovs: "#9aa83a", concatenate: "#c3a6d8" };
  const FAILED = "#d13b2e";
  const attempts = [];
  let state = null, index = 0, playing = null, known = new Set();

  const address = number => `frame?number=${number}`;
  const made = (tag, text, properties = {}) => Object.assign(document.createElement(tag), text === null ? {} : { textContent: text }, properties);

  // ---- pictures: each costs the machine time, so new ones come no faster than one hundred-and-fiftieth of a core allows --
  const loaded = new Map();
  let owed = 0; // milliseconds of waiting
  async function picture(number) {
    if (!loaded.has(number)) {
      const answer = await fetch(address(number));
      if (!answer.ok) return null;
      owed = 150000 * Number(answer.headers.get("X-Seconds"));
      loaded.set(number, URL.createObjectURL(await answer.blob()));
      while (loaded.size > 800) {
        const [oldest, url] = loaded.entries().next().value;
        URL.revokeObjectURL(url);
        loaded.delete(oldest);
      }
    }
    return loaded.get(number);
  }

  // ---- film strip -----------------------------------------------------------------------------------
  let strip = Promise.resolve(), nextStrip = 0;
  function showStrip() {
    $("none").hidden = state.newest.length > 0;
    const wanted = [...state.newest].reverse();
    for (const figure of [...$("film").children]) if (!wanted.includes(Number(figure.dataset.number))) figure.remove();
    wanted.forEach((number, place) => {
      let figure = $("film").querySelector(`[data-number="${number}"]`);
      if (!figure) {
        figure = made("figure", null);
        figure.dataset.number = number;
        const button = made("button", null, { type: "button", onclick: () => seek(number) });
        button.setAttribute("aria-label", `Show frame ${number}`);
        button.append(made("div", null, { className: "empty" }));
        figure.append(button, made("figcaption", `frame ${number}`));
      }
      if ($("film").children[place] !== figure) $("film").insertBefore(figure, $("film").children[place] || null);
    });
    fillStrip();
  }
  async function fillStrip() {
    if (performance.now() < nextStrip) return;
    const first = known.size === 0 ? 8 : 1;
    const waiting = [...$("film").querySelectorAll("figure")].filter(figure => figure.querySelector(".empty")).slice(0, first);
    for (const figure of waiting) {
      nextStrip = Infinity;
      const number = Number(figure.dataset.number), url = await picture(number);
      known.add(number);
      if (url) figure.querySelector(".empty").replaceWith(made("img", null, { src: url, alt: "" }));
    }
    nextStrip = performance.now() + owed;
  }

  // ---- player ---------------------------------------------------------------------------------------
  async function seek(number) {
    index = Math.max(0, state.frames.indexOf(number));
    return show();
  }
  async function show() {
    const frames = state.frames, number = frames[index];
    $("slider").max = Math.max(0, frames.length - 1);
    $("slider").value = index;
    $("frame").textContent = `frame ${number}`;
    const url = await picture(number);
    if (url && frames[index] === number) Object.assign($("picture"), { src: url, alt: `Frame ${number}` });
    $("picture").dataset.frame = number;
  }
  function step(by) {
    index = (index + by + state.frames.length) % state.frames.length;
    return show();
  }
  function play(on) {
    playing = on ? {} : null;
    $("play").textContent = on ? "Pause" : "Play";
    $("play").setAttribute("aria-pressed", on);
    const mine = playing;
    const next = async () => {
      if (playing !== mine || !mine) return;
      const started = performance.now();
      await step(1);
      setTimeout(next, Math.max(0, 1000 / state.fps - (performance.now() - started)));
    };
    if (on) next();
  }
  $("play").onclick = () => play(!playing);
  $("back").onclick = () => { play(false); step(-1); };
  $("on").onclick = () => { play(false); step(1); };
  $("slider").oninput = () => { play(false); index = Number($("slider").value); show(); };

  // ---- timeline -------------------------------------------------------------------------------------
  function clock(seconds) {
    const s = Math.round(seconds);
    if (seconds > 0 && seconds < 9.95) return `${seconds.toFixed(1)} s`;
    return s < 60 ? `${s} s` : s < 3600 ? `${Math.floor(s / 60)} min ${String(s % 60).padStart(2, "0")} s` : `${Math.floor(s / 3600)} h ${String(Math.floor(s / 60) % 60).padStart(2, "0")} min`;
  }
  // The time in which no command worked is left out: gaps of more than two minutes become ten seconds.
  function squeezed(spans) {
    const cuts = [];
    let until = null, shift = 0;
    for (const [start, end] of [...spans].sort((a, b) => a[0] - b[0])) {
      if (until !== null && start - until > 120) { shift += start - until - 10; cuts.push([start, shift]); }
      until = Math.max(until ?? end, end);
    }
    return time => {
      let by = 0;
      for (const [start, sum] of cuts) if (time >= start) by = sum;
      return time - by;
    };
  }
  let boxes = [];
  function drawTimeline() {
    if (!attempts.length) return;
    const canvas = $("timeline").querySelector("canvas"), style = getComputedStyle(document.body);
    const workers = [...new Set(attempts.map(each => each.worker))].slice(0, 64);
    const at = squeezed(attempts.map(each => [each.start, each.end]));
    const [from, to] = [Math.min(...attempts.slice(0, 500).map(e => at(e.start))), attempts.reduce((most, e) => Math.max(most, at(e.end)), 0)];
    const wide = canvas.clientWidth, row = workers.length > 16 ? 8 : 18, high = workers.length * row + 22, scale = devicePixelRatio || 1;
    Object.assign(canvas, { width: wide * scale, height: high * scale });
    canvas.style.height = `${high}px`;
    const drawn = canvas.getContext("2d");
    drawn.scale(scale, scale);
    drawn.font = "11.5px system-ui, sans-serif";
    drawn.fillStyle = style.getPropertyValue("--quiet");
    const x = time => (time - from) / Math.max(to - from, 1e-3) * (wide - 2);
    const ticks = wide > 520 ? 4 : 2;
    for (let k = 0; k <= ticks; k++) {
      drawn.textAlign = k === 0 ? "left" : k === ticks ? "right" : "center";
      drawn.fillText(clock((to - from) * k / ticks), wide * k / ticks, high - 5);
    }
    boxes = [];
    for (const each of attempts) {
      const line = workers.indexOf(each.worker);
      if (line < 0) continue;
      const left = x(at(each.start)), width = Math.max(1, x(at(each.end)) - left - 0.5), top = line * row + 1;
      drawn.fillStyle = each.outcome === "done" ? STAGES[each.stage] || "#888" : FAILED;
      drawn.fillRect(left, top, width, row - 2);
      boxes.push([left, top, width, row - 2, each]);
    }
    const stages = [...new Set(attempts.map(each => each.stage))];
    $("timeline").querySelector(".legend").replaceChildren(...[...stages.map(name => [name, STAGES[name] || "#888"]), ["failed or lost", FAILED]].map(([name, colour]) => {
      const item = made("li", null);
      item.append(made("i", null, { style: `background: ${colour}` }), name);
      return item;
    }));
    canvas.setAttribute("aria-label", `${attempts.length} attempts at tasks on ${workers.length} workers in ${clock(to - from)}`);
  }
  $("timeline").querySelector("canvas").onmousemove = event => {
    const { offsetX: x, offsetY: y } = event;
    const found = boxes.find(([left, top, width, height]) => x >= left - 1 && x <= left + width + 1 && y >= top && y <= top + height);
    $("under").textContent = found ? `${found[4].task}, attempt ${found[4].attempt}: ${found[4].outcome} after ${clock(found[4].end - found[4].start)} on ${found[4].worker}` : "";
  };

  // ---- the rest -------------------------------------------------------------------------------------
  const WORDS = { running: "rendering", done: "finished", stopped: "stopped; the same command resumes", failed: "failed; the same command resumes", killed: "interrupted; the same command resumes", waiting: "waiting for a render to begin", unknown: "cannot be read" };
  function tell() {
    $("title").textContent = state.title || state.name;
    $("status").textContent = WORDS[state.status] || state.status;
    const [done, all] = state.tasks;
    const parts = [all ? `${done} of ${all} tasks` : "", state.wanted ? `${state.frames.length} of ${state.wanted} frames` : "", state.workers ? `${state.workers} worker${state.workers > 1 ? "s" : ""}` : "", state.spent && `${state.spent} spent`, state.left];
    $("told").textContent = parts.filter(Boolean).join(" · ");
    document.title = `${all ? `${Math.floor(100 * done / all)} % ` : ""}${state.title || state.name}: live`;
    $("notices").replaceChildren(...state.notices.map(text => made("p", text, { className: "notice" })));
    $("bars").replaceChildren(...state.passes.map(({ name, done: part, total }) => {
      const label = made("label", name);
      label.append(made("progress", null, { max: total, value: part }), made("span", `${part} of ${total}`));
      return label;
    }));
    const failed = attempts.filter(each => each.outcome !== "done");
    $("well").hidden = failed.length > 0;
    $("failures").replaceChildren(...failed.slice(-50).reverse().map(each => made("li", `${each.task}: attempt ${each.attempt} ${each.outcome}${each.cause ? ` (${each.cause})` : ""} on ${each.worker}${each.why ? `: ${each.why}` : ""}`)));
  }

  async function look() {
    try {
      const answer = await fetch(`state?since=${attempts.length}`);
      if (!answer.ok) throw new Error(answer.statusText);
      const next = await answer.json();
      if (next.count < attempts.length) { attempts.length = 0; return look(); } // another run began here
      const news = next.attempts.length > 0 || state === null;
      attempts.push(...next.attempts);
      const before = state ? state.frames[index] : null;
      state = next;
      if (before !== null) index = Math.max(0, state.frames.indexOf(before));
      tell();
      if (news) drawTimeline();
      showStrip();
      if (state.frames.length && $("player").hidden) {
        $("player").hidden = false;
        index = state.frames.length - 1;
        show();
      }
      $("slider").max = Math.max(0, state.frames.length - 1);
    } catch (error) {
      $("status").textContent = "the command that serves this page has ended";
    }
    document.documentElement.dataset.ready = "yes";
    setTimeout(look, document.hidden ? 10000 : state && state.status === "done" ? 5000 : 2000);
  }
  addEventListener("resize", drawTimeline);
  look();
})();
