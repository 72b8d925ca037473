"use strict";
// The comparison page: players that show one frame number together, views of two films, graphs that follow.
// Pictures are decoded one by one, and drawn only when all of a frame are there: the players cannot drift apart.
(() => {
  const $ = id => document.getElementById(id);
  const data = JSON.parse($("data").textContent);
  const { numbers, runs, grid } = data;
  const COLOURS = ["#d1495b", "#0b7a75", "#3f6fb5", "#b5791c", "#7a4fa3", "#5c6268"];
  const bytes = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  for (const run of runs) run.sums = new Float32Array(bytes(run.sums).buffer);

  // ---- pictures -----------------------------------------------------------------------------------
  const decoded = new Map();
  const KEPT = 24 * Math.max(runs.length, 2);
  function picture(run, kind, index) {
    const source = runs[run][kind] && runs[run][kind][index];
    if (!source) return Promise.resolve(null);
    const key = `${run} ${kind} ${index}`;
    let found = decoded.get(key);
    if (found) decoded.delete(key);
    else found = createImageBitmap(new Blob([bytes(source)], { type: "image/jpeg" }));
    decoded.set(key, found); // the newest is last
    while (decoded.size > KEPT) {
      const [oldest, bitmap] = decoded.entries().next().value;
      decoded.delete(oldest);
      bitmap.then(image => image.close());
    }
    return found;
  }

  // ---- what is shown ------------------------------------------------------------------------------
  const state = { index: 0, layout: "films", playing: false, loop: true, speed: 1 };
  const players = [...document.querySelectorAll(".player canvas")];
  const stage = $("stage").firstElementChild;
  const layoutNow = () => document.querySelector("input[name=layout]:checked").value;
  const pair = () => [Number($("left").value), Number($("right").value)];
  const context = canvas => canvas.getContext("2d", { willReadFrequently: true });
  const ABOUT = {
    films: "",
    heat: `Bright: the light of a surface point changes from frame to frame, wherever the camera moves (white: ${100 * data.flickerFull} % or more).`,
    wipe: "Left of the edge is the left film, right of it the right one. Drag over the picture to move the edge.",
    difference: "The absolute difference of both pictures. Black: they are equal.",
    flicker: "Orange: the left film flickers more there. Blue: the right one. Black: both alike.",
  };

  function needed(layout, index) {
    const kind = layout === "heat" || layout === "flicker" ? "flicker" : "pictures";
    const which = layout === "films" || layout === "heat" ? runs.map((_, run) => run) : pair();
    return Promise.all(which.map(run => picture(run, kind, index)));
  }

  function fit(canvas, image) {
    const [width, height] = image ? [image.width, image.height] : data.size;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    return context(canvas);
  }

  function say(canvas, words) {
    const drawn = fit(canvas, null);
    drawn.fillStyle = "#000";
    drawn.fillRect(0, 0, canvas.width, canvas.height);
    drawn.fillStyle = "#bbb";
    drawn.font = `${Math.max(10, canvas.width / 24)}px system-ui, sans-serif`;
    drawn.textAlign = "center";
    drawn.fillText(words, canvas.width / 2, canvas.height / 2);
  }

  // Dark to bright through the colours of a flame, as most people read them.
  const FLAME = Array.from({ length: 256 }, (_, k) => {
    const x = k / 255;
    return [255 * Math.min(1, 2.2 * x), 255 * Math.max(0, Math.min(1, 2 * x - 0.6)), 255 * Math.max(0, 3 * x - 2)];
  });
  function recolour(canvas, colour) {
    const drawn = context(canvas), pixels = drawn.getImageData(0, 0, canvas.width, canvas.height), p = pixels.data;
    for (let k = 0; k < p.length; k += 4) [p[k], p[k + 1], p[k + 2]] = colour(p, k);
    drawn.putImageData(pixels, 0, 0);
  }

  const lacking = run => (runs[run].flicker ? "no frame before this one" : "no flicker pictures");
  function drawPlayers(layout, images) {
    images.forEach((image, run) => {
      const canvas = players[run];
      if (!image) return say(canvas, layout === "heat" ? lacking(run) : `no frame ${numbers[state.index]}`);
      fit(canvas, image).drawImage(image, 0, 0);
      if (layout === "heat") recolour(canvas, (p, k) => FLAME[p[k]]);
    });
  }

  function drawPair(layout, [left, right]) {
    if (!left || !right) return say(stage, layout === "flicker" ? lacking(left ? pair()[1] : pair()[0]) : `no frame ${numbers[state.index]}`);
    const drawn = fit(stage, left), { width, height } = stage;
    drawn.globalCompositeOperation = "source-over";
    drawn.drawImage(left, 0, 0);
    if (layout === "wipe") {
      const edge = Math.round(width * $("edge").value / 100);
      if (edge < width) drawn.drawImage(right, edge, 0, width - edge, height, edge, 0, width - edge, height);
      drawn.fillStyle = "#fff";
      drawn.fillRect(edge - 1, 0, Math.max(1, width / 400), height);
      return;
    }
    if (layout === "difference") {
      drawn.globalCompositeOperation = "difference";
      drawn.drawImage(right, 0, 0);
      drawn.globalCompositeOperation = "lighter";
      for (let k = 0; k < Number($("gain").value); k++) drawn.drawImage(stage, 0, 0);
      drawn.globalCompositeOperation = "source-over";
      return;
    }
    const other = Object.assign(document.createElement("canvas"), { width, height });
    context(other).drawImage(right, 0, 0, width, height);
    const q = context(other).getImageData(0, 0, width, height).data;
    recolour(stage, (p, k) => {
      const more = p[k] - q[k];
      return more > 0 ? [Math.min(255, 2 * more), 1.1 * more, 0] : [0, -1.1 * more, Math.min(255, -2 * more)];
    });
  }

  // One draw at a time; what was asked for meanwhile is drawn next.
  let drawing = null, again = false;
  function draw() {
    if (drawing) return (again = true), drawing;
    const { index, layout } = state;
    drawing = needed(layout, index).then(images => {
      if (layout === "films" || layout === "heat") drawPlayers(layout, images);
      else drawPair(layout, images);
      for (const canvas of [...players, stage]) {
        canvas.dataset.frame = numbers[index];
        const name = canvas === stage ? $("about").textContent : runs[canvas.dataset.run].name;
        canvas.setAttribute("aria-label", `${name}, frame ${numbers[index]}`);
      }
      for (let next = 1; next <= 4; next++) needed(layout, (index + next) % numbers.length);
    }).finally(() => {
      drawing = null;
      if (again) { again = false; draw(); }
    });
    return drawing;
  }

  function show(index) {
    state.index = Math.max(0, Math.min(numbers.length - 1, index));
    $("slider").value = state.index;
    $("frame").textContent = `frame ${numbers[state.index]}`;
    for (const graph of graphs) placeHead(graph);
    return draw();
  }

  function arrange() {
    state.layout = layoutNow();
    const two = !["films", "heat"].includes(state.layout);
    $("players").hidden = two;
    $("stage").hidden = $("pair").hidden = !two;
    $("wiper").hidden = state.layout !== "wipe";
    $("gainer").hidden = state.layout !== "difference";
    $("about").textContent = ABOUT[state.layout];
    return draw();
  }

  // ---- time ---------------------------------------------------------------------------------------
  let since = 0, from = 0;
  function play(on) {
    state.playing = on;
    $("play").textContent = on ? "Pause" : "Play";
    $("play").setAttribute("aria-pressed", on);
    if (!on) return;
    if (state.index === numbers.length - 1) state.index = 0;
    [since, from] = [performance.now(), state.index];
    requestAnimationFrame(tick);
  }
  function tick(now) {
    if (!state.playing) return;
    let index = from + Math.floor(Math.max(0, now - since) / 1000 * data.fps * state.speed);
    if (index >= numbers.length) {
      if (!state.loop) return show(numbers.length - 1), play(false);
      index %= numbers.length;
    }
    if (index === state.index) return requestAnimationFrame(tick);
    show(index).then(() => requestAnimationFrame(tick));
  }
  function step(by) {
    play(false);
    const count = numbers.length, next = state.index + by;
    return show(state.loop ? (next + count) % count : next);
  }
  function setSpeed(value) {
    state.speed = value;
    $("speed").value = value;
    [since, from] = [performance.now(), state.index];
  }

  // ---- graphs -------------------------------------------------------------------------------------
  const graphs = [];
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const ink = () => getComputedStyle(document.body).getPropertyValue("--quiet").trim();
  const rule = () => getComputedStyle(document.body).getPropertyValue("--rule").trim();
  const fine = value => (value === 0 ? "0" : Math.abs(value) < 0.001 ? value.toExponential(1) : String(Number(value.toPrecision(3))));

  function graph(place, title, series, options = {}) {
    const card = document.createElement("div");
    card.className = "card";
    card.innerHTML = '<div class="head"><h3></h3></div><ul class="legend"></ul><div role="img"></div>';
    card.querySelector("h3").textContent = title;
    const plotted = card.lastElementChild, head = card.firstElementChild;
    place.append(card);
    const made = { card, title, plot: null };
    if (options.remove) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = "Remove";
      button.setAttribute("aria-label", `Remove ${title}`);
      button.onclick = () => { drop(made); options.remove(); };
      head.append(button);
    }
    made.update = values => {
      const means = [];
      card.querySelector(".legend").replaceChildren(...values.map((line, run) => {
        const known = line.filter(value => value !== null), item = document.createElement("li");
        const mean = known.length ? known.reduce((a, b) => a + b, 0) / known.length : null;
        const swatch = Object.assign(document.createElement("i"), { style: `background: ${COLOURS[run % 6]}` });
        means.push(`${runs[run].name} ${mean === null ? "none" : fine(mean)}`);
        item.append(swatch, mean === null ? `${runs[run].name}: –` : `${runs[run].name}: mean ${fine(mean)}`);
        return item;
      }));
      plotted.setAttribute("aria-label", `${title}, frames ${numbers[0]} to ${numbers[numbers.length - 1]}; means: ${means.join(", ")}`);
      made.values = values;
      if (made.plot) made.plot.setData([numbers, ...values]);
      else made.plot = plotInto(plotted, values);
      placeHead(made);
    };
    made.redraw = () => {
      made.plot.destroy();
      made.plot = plotInto(plotted, made.values);
      placeHead(made);
    };
    graphs.push(made);
    made.update(series);
    return made;
  }

  function plotInto(place, values) {
    const axis = { stroke: ink(), grid: { stroke: rule(), width: 1 }, ticks: { show: false } };
    const plot = new uPlot({
      width: Math.max(240, place.clientWidth), height: 190,
      legend: { show: false },
      cursor: { sync: { key: "all" }, drag: { x: true, y: false }, points: { size: 6 } },
      scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(0, low || 0), (high || 1) * 1.06] } },
      axes: [{ ...axis, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000] }, { ...axis, size: 62, values: (_, ticks) => ticks.map(fine) }],
      series: [{}, ...values.map((_, run) => ({
        label: runs[run].name, stroke: COLOURS[run % 6], width: 1.6, spanGaps: false,
        points: { show: numbers.length < 3 },
      }))],
    }, [numbers, ...values], place);
    const head = Object.assign(document.createElement("div"), { className: "playhead" });
    plot.over.append(head);
    plot.over.addEventListener("click", () => {
      if (plot.cursor.idx !== null && plot.cursor.idx !== undefined) { play(false); show(plot.cursor.idx); }
    });
    return plot;
  }
  function placeHead({ plot }) {
    if (plot) plot.over.lastElementChild.style.left = `${plot.valToPos(numbers[state.index], "x")}px`;
  }
  function drop(made) {
    graphs.splice(graphs.indexOf(made), 1);
    made.plot.destroy();
    made.card.remove();
  }
  const redrawAll = () => graphs.forEach(made => made.redraw());
  dark.addEventListener("change", redrawAll);
  new ResizeObserver(() => graphs.forEach(made => {
    const width = made.card.lastElementChild.clientWidth;
    if (made.plot && width > 0 && Math.abs(width - made.plot.width) > 2) made.plot.setSize({ width, height: 190 });
    placeHead(made);
  })).observe($("regions"));

  // ---- regions ------------------------------------------------------------------------------------
  const marks = [];
  const ends = (from, to, size, count) => {
    const first = Math.max(0, Math.min(count - 1, Math.floor(from * size / grid.block)));
    return [first, Math.max(first + 1, Math.min(count, Math.ceil(to * size / grid.block)))];
  };
  function bfm(run, [x0, x1, y0, y1]) {
    const light = numbers.map((_, t) => {
      let sum = 0;
      for (let y = y0; y < y1; y++)
        for (let x = x0; x < x1; x++) sum += runs[run].sums[(t * grid.rows + y) * grid.columns + x];
      return sum;
    });
    const known = light.filter(value => !Number.isNaN(value));
    const mean = known.reduce((a, b) => a + b, 0) / known.length;
    return light.map((value, t) => {
      const change = t && numbers[t] === numbers[t - 1] + 1 ? Math.abs(value - light[t - 1]) / (mean || 1) : NaN;
      return Number.isNaN(change) ? null : change;
    });
  }
  function mark(x0, y0, x1, y1, whole = false) {
    const [width, height] = grid.size;
    const blocks = [...ends(x0, x1, width, grid.columns), ...ends(y0, y1, height, grid.rows)];
    const [left, right, top, bottom] = blocks.map((edge, k) => Math.min(edge * grid.block, k < 2 ? width : height));
    const title = whole ? "BFM of the whole picture" : `BFM of pixels ${left},${top} to ${right},${bottom}`;
    const lines = runs.map((_, run) => bfm(run, blocks));
    const made = { boxes: [] };
    if (!whole) {
      const colour = ["#f2b134", "#58c4dd", "#e58fb1", "#9bd35a"][marks.length % 4];
      made.boxes = players.map(canvas => {
        const box = Object.assign(document.createElement("div"), { className: "mark-box" });
        Object.assign(box.style, { borderColor: colour });
        box.dataset.edges = JSON.stringify([left / width, top / height, right / width, bottom / height]);
        canvas.parentElement.append(box);
        return box;
      });
      placeBoxes();
    }
    made.graph = graph($("regions"), title, lines, whole ? {} : {
      remove: () => { made.boxes.forEach(box => box.remove()); marks.splice(marks.indexOf(made), 1); },
    });
    marks.push(made);
    return made;
  }
  function setBox(box, canvas, [x0, y0, x1, y1]) {
    const { clientWidth: w, clientHeight: h } = canvas;
    Object.assign(box.style, { left: `${x0 * w}px`, top: `${y0 * h}px`, width: `${(x1 - x0) * w}px`, height: `${(y1 - y0) * h}px` });
  }
  const placeBoxes = () => marks.forEach(({ boxes }) => boxes.forEach((box, run) => setBox(box, players[run], JSON.parse(box.dataset.edges))));
  new ResizeObserver(() => { placeBoxes(); }).observe($("players"));

  function place(canvas, event) {
    const { left, top, width, height } = canvas.getBoundingClientRect();
    return [(event.clientX - left) / width, (event.clientY - top) / height].map(x => Math.max(0, Math.min(1, x)));
  }
  for (const canvas of players) {
    let began = null, box = null;
    const edges = event => {
      const [x, y] = place(canvas, event);
      return [Math.min(x, began[0]), Math.min(y, began[1]), Math.max(x, began[0]), Math.max(y, began[1])];
    };
    canvas.onpointerdown = event => {
      if (event.button) return;
      canvas.setPointerCapture(event.pointerId);
      began = place(canvas, event);
      box = Object.assign(document.createElement("div"), { className: "mark-box", style: "border-color: #fff" });
      canvas.parentElement.append(box);
    };
    canvas.onpointermove = event => { if (began) setBox(box, canvas, edges(event)); };
    canvas.onpointerup = event => {
      if (!began) return;
      const [x0, y0, x1, y1] = edges(event);
      box.remove();
      began = null;
      if (x1 - x0 > 0.01 && y1 - y0 > 0.01) mark(x0, y0, x1, y1);
    };
    canvas.onpointercancel = () => { if (began) { box.remove(); began = null; } };
  }
  const wipeTo = event => {
    if (state.layout !== "wipe" || !event.buttons) return;
    $("edge").value = 100 * place(stage, event)[0];
    draw();
  };
  stage.onpointerdown = event => { stage.setPointerCapture(event.pointerId); wipeTo(event); };
  stage.onpointermove = wipeTo;

  // ---- controls -----------------------------------------------------------------------------------
  $("slider").max = numbers.length - 1;
  $("slider").oninput = () => { play(false); show(Number($("slider").value)); };
  $("play").onclick = () => play(!state.playing);
  $("back").onclick = () => step(-1);
  $("on").onclick = () => step(1);
  const setLoop = on => { state.loop = on; $("loop").setAttribute("aria-pressed", on); };
  $("loop").onclick = () => setLoop(!state.loop);
  $("speed").onchange = () => setSpeed(Number($("speed").value));
  $("right").value = Math.min(1, runs.length - 1);
  for (const id of ["left", "right", "gain"]) $(id).onchange = draw;
  $("edge").oninput = draw;
  $("layouts").onchange = arrange;
  $("add").onclick = () => {
    const [x0, y0, x1, y1] = ["x0", "y0", "x1", "y1"].map(id => Math.max(0, Math.min(100, Number($(id).value))) / 100);
    if (x0 < x1 && y0 < y1) mark(x0, y0, x1, y1);
  };
  document.addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT)$/.test(event.target.tagName) && event.target.type !== "radio") return;
    const onButton = event.target.tagName === "BUTTON" || event.target.type === "radio";
    const actions = {
      ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => step(-state.index),
      End: () => step(numbers.length - 1 - state.index), " ": () => play(!state.playing),
      l: () => setLoop(!state.loop), s: () => setSpeed(state.speed === 1 ? 0.25 : 1),
    };
    const layouts = document.querySelectorAll("input[name=layout]");
    const action = actions[event.key] || (layouts[event.key - 1] && (() => { layouts[event.key - 1].checked = true; arrange(); }));
    if (!action || onButton && (event.key === " " || event.target.type === "radio" && event.key.startsWith("Arrow"))) return;
    event.preventDefault();
    action();
  });

  const shown = [...new Set(runs.flatMap(run => Object.keys(run.measures)))];
  mark(0, 0, 1, 1, true);
  const WORDS = { "temporal deviation": "Temporal deviation: mean change of surface points since the frame before" };
  for (const name of shown)
    graph($("measures"), WORDS[name] || `${name} against the reference`, runs.map(run => run.measures[name] || numbers.map(() => null)));
  $("measures").parentElement.hidden = shown.length === 0;
  show(0);
  document.documentElement.dataset.ready = "yes";
  window.steadylight = { show, step, play, state }; // for scripts and tests
})();
