// Draws the Bode plots of a page with uPlot: values under the pointer, zoom by dragging, reset by a
// double click. Colours follow the scheme of the page.
(() => {
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const curve = {
    measured: { colour: "--measured", width: 4 },
    nominal: { colour: "--nominal", width: 1.5, dash: [7, 4] },
    matched: { colour: "--matched", width: 1.8 },
  };
  const label = { measured: "measured", nominal: "nominal gains", matched: "matched gains" };

  function band(chart) {
    return {
      hooks: {
        drawClear: (plot) => {
          const left = plot.valToPos(Math.max(chart.band_hz[0], plot.scales.x.min), "x", true);
          const right = plot.valToPos(Math.min(chart.band_hz[1], plot.scales.x.max), "x", true);
          plot.ctx.fillStyle = style("--band");
          plot.ctx.fillRect(left, plot.bbox.top, right - left, plot.bbox.height);
        },
      },
    };
  }

  function draw(element) {
    const chart = JSON.parse(element.querySelector("script").textContent);
    const key = element.id;
    const axis = { stroke: style("--text"), grid: { stroke: style("--line"), width: 1 },
                   ticks: { stroke: style("--line"), width: 1 }, font: "12px system-ui, sans-serif" };
    const plots = chart.panels.map((panel, number) => {
      const last = number === chart.panels.length - 1;
      const series = [{ label: "frequency", value: (_, hz) => hz === null ? "" : hz.toFixed(2) + " Hz" }];
      const data = [chart.frequency_hz];
      for (const [name, values] of Object.entries(panel.curves)) {
        series.push({ label: label[name], stroke: style(curve[name].colour), width: curve[name].width,
                      dash: curve[name].dash, points: { show: false },
                      value: (_, value) => value === null ? "" : value.toFixed(2) });
        data.push(values);
      }
      return new uPlot({
        width: element.clientWidth,
        height: [220, 150, 190][number],
        scales: { x: { time: false, distr: 3, range: (_, low, high) => [low, high] } },
        series,
        axes: [
          { ...axis, show: true, size: last ? 46 : 26, label: last ? "frequency [Hz]" : null,
            labelSize: 18, values: (_, splits) => splits.map((hz) =>
              hz !== null && [1, 2, 5].includes(Math.round(hz / 10 ** Math.floor(Math.log10(hz) + 1e-9))) ? +hz.toPrecision(2) : "") },
          { ...axis, label: panel.label, labelSize: 18, size: 46 },
        ],
        cursor: { sync: { key, setSeries: false }, drag: { x: true, y: false } },
        legend: { live: true },
        plugins: [band(chart)],
      }, data, element);
    });
    // A zoom of one panel is a zoom of all.
    let busy = false;
    for (const plot of plots) {
      plot.hooks.setScale = [(self, scale) => {
        if (scale !== "x" || busy) return;
        busy = true;
        for (const other of plots) {
          if (other !== self) other.setScale("x", { min: self.scales.x.min, max: self.scales.x.max });
        }
        busy = false;
      }];
    }
    new ResizeObserver(() => {
      if (element.clientWidth === 0) return;
      plots.forEach((plot) => plot.setSize({ width: element.clientWidth, height: plot.height }));
    }).observe(element);
    return plots;
  }

  const drawn = new Map();
  function drawVisible() {
    for (const element of document.querySelectorAll(".chart")) {
      if (element.clientWidth > 0 && !drawn.has(element)) drawn.set(element, draw(element));
    }
  }
  drawVisible();
  for (const fold of document.querySelectorAll("details")) fold.addEventListener("toggle", drawVisible);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const [element, plots] of drawn) {
      plots.forEach((plot) => plot.destroy());
      drawn.set(element, draw(element));
    }
  });
})();
