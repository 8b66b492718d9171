"use strict";
(() => {
  const page = JSON.parse(document.getElementById("data").textContent);
  const slider = document.getElementById("slider");
  const frame = document.getElementById("frame");
  const text = document.getElementById("frame-text");
  const turn = () => {
    const item = page.gallery[Number(slider.value)];
    frame.src = item.src;
    frame.alt = "Keyframe with tracks drawn: " + item.text;
    text.textContent = item.text;
    slider.setAttribute("aria-valuetext", item.text);
  };
  if (slider) {
    slider.addEventListener("input", turn);
    turn();
  }

  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const merge = (base, more) => {
    const out = { ...base };
    for (const [key, value] of Object.entries(more)) {
      const both = value && out[key] && typeof value === "object" && !Array.isArray(value);
      out[key] = both ? merge(out[key], value) : value;
    }
    return out;
  };
  // A camera that has all of what is shown in view, as large as it can be: from beside and a little above, and the
  // wider the view (`aspect`: of its height) the more from the side. Plotly sees 45 degrees from bottom to top.
  const seen = (chart, scene, aspect) => {
    const keys = ["x", "y", "z"];
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const unit = (a) => a.map((v) => v / Math.hypot(...a));
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const places = [];
    for (const trace of chart.data.filter((t) => t.visible !== "legendonly")) {
      const step = Math.ceil(trace.x.length / 2000);
      for (let n = 0; n < trace.x.length; n += step) {
        if (trace.x[n] === null) continue;
        places.push(keys.map((k) => {
          const [low, high] = scene[k + "axis"].range;
          return scene.aspectratio[k] * ((trace[k][n] - low) / (high - low) - 0.5);
        }));
      }
    }
    const level = Math.hypot(chart.along[0], chart.along[1]) > 0.2 ? unit([chart.along[0], chart.along[1], 0]) : [0, 1, 0];
    const turn = (Math.PI / 180) * Math.min(62, Math.max(25, 25 + 40 * (aspect - 1)));
    const side = cross(level, [0, 0, 1]);
    const back = unit(keys.map((_, i) => Math.sin(turn) * side[i] - Math.cos(turn) * level[i] + (i === 2 ? 0.35 : 0)));
    const right = unit(cross([0, 0, 1], back)), up = cross(back, right);
    // A place is inside where |across - middle| <= share * (away - depth), for both directions across.
    const share = [0.92 * aspect * Math.tan(Math.PI / 8), 0.85 * Math.tan(Math.PI / 8)]; // with room for names
    const ends = [right, up].map((way, i) => [
      Math.min(...places.map((p) => dot(p, way) - share[i] * dot(p, back))),
      Math.max(...places.map((p) => dot(p, way) + share[i] * dot(p, back))),
    ]);
    const [across, over] = ends.map(([low, high]) => (low + high) / 2);
    const away = Math.max(...ends.map(([low, high], i) => (high - low) / 2 / share[i]));
    const at = (depth) => Object.fromEntries(keys.map((k, i) => [k, across * right[i] + over * up[i] + depth * back[i]]));
    const depths = places.map((p) => dot(p, back));
    return { eye: at(away), center: at((Math.min(...depths) + Math.max(...depths)) / 2) };
  };
  for (const chart of page.charts) chart.place = document.getElementById("plot-" + chart.id);
  const draw = (charts) => {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const axis = {
      gridcolor: colour("--line"), linecolor: colour("--line"), zerolinecolor: colour("--line"),
      tickfont: { size: 12 }, title: { font: { size: 13 }, standoff: 8 }, automargin: true, fixedrange: true,
    };
    const layout = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: getComputedStyle(document.body).fontFamily, color: colour("--muted") },
      colorway: dark.matches ? ["#4cc3cd", "#f0a35e", "#b79cf0", "#8fc866", "#e8799a", "#d6c24e", "#7aa6f2"]
        : ["#0f7f89", "#c8641b", "#6d4bc4", "#4d8a22", "#b83a63", "#8f7a00", "#2f62c0"],
      uirevision: "keep", // what a reader turned stays when all is drawn again
      margin: { l: 54, r: 12, t: 8, b: 44 }, bargap: 0.06, dragmode: false,
      legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { size: 12 } },
      hoverlabel: { font: { size: 13 } },
    };
    for (const chart of charts) {
      const axes = {};
      for (const key of ["xaxis", "yaxis", "yaxis2"]) {
        if (chart.layout[key]) axes[key] = axis;
      }
      if (chart.layout.polar) {
        const ring = { gridcolor: colour("--line"), linecolor: colour("--line"), tickfont: { size: 11 } };
        axes.polar = { radialaxis: ring, angularaxis: ring };
      }
      if (chart.layout.scene) {
        const side = { gridcolor: colour("--line"), zerolinecolor: colour("--line"), backgroundcolor: "rgba(0,0,0,0)",
          showspikes: false, tickfont: { size: 11 } };
        axes.scene = { xaxis: side, yaxis: side, zaxis: side };
      }
      const whole = merge(merge(layout, axes), chart.layout);
      [whole.width, whole.height] = chart.size = [chart.place.clientWidth, chart.place.clientHeight];
      if (chart.along) {
        const tall = whole.height * (1 - whole.scene.domain.y[0]) - whole.margin.t;
        whole.scene.camera = seen(chart, whole.scene, whole.width / tall);
      }
      Plotly.react(chart.place, chart.data, whole, { displayModeBar: false });
      if (!chart.along) Plotly.redraw(chart.place); // else a legend that has got more lines lies on the curves
    }
  };
  for (const chart of page.charts.filter((c) => c.choice)) {
    const select = document.getElementById("choice-" + chart.id);
    const choose = () => {
      chart.data.forEach((trace, i) => { trace.visible = Math.floor(i / chart.choice.traces) === select.selectedIndex; });
    };
    select.addEventListener("change", () => { choose(); draw([chart]); });
    choose(); // browsers keep a choice when a page is loaded again
  }
  draw(page.charts);
  dark.addEventListener("change", () => draw(page.charts));

  // Only what has got another size, once the window rests: a phone's bars come and go as one scrolls.
  const fit = () => {
    draw(page.charts.filter(({ place, size }) => place.clientWidth !== size[0] || place.clientHeight !== size[1]));
  };
  let waiting = 0;
  window.addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(fit, 200);
  });
  // No such event comes for paper, and how wide it is nobody tells: A4 with the style's margins holds so much of a card.
  const shape = (width, height) => {
    for (const { place } of page.charts) Object.assign(place.style, { width, height: height && height(place) });
    fit();
  };
  window.addEventListener("beforeprint", () => {
    shape("655px", (place) => place.clientHeight + "px");
    // Of 3-D paper gets what the screen had last, in its old shape, but of a flat canvas what is on it.
    for (const { place } of page.charts) {
      place._fullLayout.scene?._scene?.glplot?.redraw();
      for (const solid of place.querySelectorAll("canvas")) {
        const flat = solid.cloneNode();
        flat.getContext("2d").drawImage(solid, 0, 0);
        flat.className = "on-paper";
        solid.after(flat);
        solid.style.visibility = "hidden";
      }
    }
  });
  window.addEventListener("afterprint", () => {
    for (const flat of document.querySelectorAll(".on-paper")) {
      flat.previousElementSibling.style.visibility = "";
      flat.remove();
    }
    shape("", "");
  });

  // The unrolled wall: the place under the pointer, and the keyframe that shows it.
  const wall = page.wall;
  if (wall) {
    const strip = document.getElementById("wall-strip");
    const view = document.getElementById("wall-view");
    const caption = document.getElementById("wall-text");
    const cursor = document.getElementById("wall-cursor");
    let column = Math.floor(Math.min(wall.columns, strip.parentElement.clientWidth) / 2), row = 0, shown = -1;
    const hour = (r) => {
      let run = wall.signs.find((s) => at(column) <= s.end) || wall.signs[wall.signs.length - 1];
      const turn = wall.cut / (2 * Math.PI) - run.clock_sign * (r + 0.5) / wall.rows;
      const minutes = Math.round((turn - Math.floor(turn)) * 720) % 720;
      return (Math.floor(minutes / 60) || 12) + ":" + String(minutes % 60).padStart(2, "0");
    };
    const at = (c) => wall.start + (c + 0.5) * wall.cell;
    const show = () => {
      let run = wall.runs.findLastIndex((r) => r[0] <= column);
      const number = run < 0 ? -1 : wall.runs[run][1];
      if (number !== shown) {
        shown = number;
        view.src = number < 0 ? "data:," : wall.frames[number].src;
        view.alt = number < 0 ? "No keyframe shows this place" : "Keyframe beside this place";
      }
      const frame = number < 0 ? "no keyframe shows this place" : wall.frames[number].text;
      caption.textContent = at(column).toFixed(2) + " " + wall.unit + ", " + hour(row) + " o'clock; " + frame;
      cursor.style.left = (100 * (column + 0.5)) / wall.columns + "%";
    };
    const point = (event) => {
      const box = strip.getBoundingClientRect();
      const inside = (x, n) => Math.min(n - 1, Math.max(0, Math.floor(x * n)));
      column = inside((event.clientX - box.left) / box.width, wall.columns);
      row = inside((event.clientY - box.top) / box.height, wall.rows);
      show();
    };
    strip.addEventListener("pointermove", point);
    strip.addEventListener("click", point);
    strip.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!step) return;
      column = Math.min(wall.columns - 1, Math.max(0, column + Math.round((step * wall.rows) / 20)));
      show();
      event.preventDefault();
      cursor.scrollIntoView({ block: "nearest", inline: "nearest" });
    });
    show();
  }
})();
