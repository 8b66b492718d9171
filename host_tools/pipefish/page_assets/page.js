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
  const draw = () => {
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
      margin: { l: 54, r: 12, t: 8, b: 44 }, bargap: 0.06, dragmode: false,
      legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { size: 12 } },
      hoverlabel: { font: { size: 13 } },
    };
    for (const chart of page.charts) {
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
      Plotly.react("plot-" + chart.id, chart.data, whole, { displayModeBar: false, responsive: true });
    }
  };
  draw();
  dark.addEventListener("change", draw);
})();
