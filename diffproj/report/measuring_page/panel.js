// What is read beside the photograph: the answer, the two tables, and what the numbers hold.
//
// Promises: whatever has a name is set as text, never as markup; each number is rounded for the eye, and whole in the
// `data-` attributes of its cell. A field keeps the focus while its table is filled anew.

const byId = (id) => document.getElementById(id);

function element(tag, { text, data = {}, on = {}, ...attributes } = {}, children = []) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  for (const [name, value] of Object.entries(data)) made.dataset[name] = value;
  for (const [name, listener] of Object.entries(on)) made.addEventListener(name, listener);
  if (text !== undefined) made.textContent = text;
  made.append(...children);
  return made;
}

function refill(table, rows) {
  const key = document.activeElement?.dataset?.key;
  table.hidden = rows.length === 0;
  table.tBodies[0].replaceChildren(...rows);
  if (key) table.querySelector(`[data-key="${CSS.escape(key)}"]`)?.focus();
}

function field(key, label, value, onChange, more = {}) {
  const input = element("input", { "aria-label": label, autocomplete: "off", data: { key }, ...more });
  input.value = value;
  input.addEventListener("change", () => onChange(input.value));
  return element("td", {}, [input]);
}

function numberCell(text, data) {
  return element("td", { class: "number", text, data });
}

function deleteCell(key, label, onClick) {
  return element("td", {}, [
    element("button", { type: "button", text: "✕", "aria-label": label, data: { key }, on: { click: onClick } }),
  ]);
}

function exactly({ value, deviation, low, high }) {
  return { value, deviation, low, high };
}

function fillMeasures(sheet, results, unit, actions) {
  const rows = sheet.measures.flatMap((measure, m) => {
    const { quantities, measured } = results[m];
    if (!quantities.length) return [];
    return quantities.map((quantity, n) => {
      const its = unitOf(quantity.what, unit);
      const name = n
        ? element("td", { text: quantity.what, class: "faint" })
        : field(`measure-${m}`, `Name of ${measure.name}`, measure.name, (text) => actions.renameMeasure(m, text), {
            maxlength: 300,
          });
      return element("tr", { class: sheet.chosen?.measure === m ? "m-chosen" : "" }, [
        name,
        element("td", {
          class: "number m-quantity",
          text: withDeviation(quantity.value, quantity.deviation, its),
          data: { what: quantity.what, ...exactly(quantity) },
        }),
        numberCell(intervalText(quantity, its), {}),
        element("td", { class: "m-remark", text: remarksOf(measured, [quantity]) }),
        n ? element("td") : deleteCell(`drop-${m}`, `Delete ${measure.name}`, () => actions.deleteMeasure(m)),
      ]);
    });
  });
  refill(byId("m-measures"), rows);
  byId("m-empty").hidden = rows.length > 0;
}

// Short, for three of them stand side by side.
const placeText = (value, deviation) =>
  deviation === Infinity ? `${plainNumber(value)} ± ∞` : withDeviation(value, deviation, "");

function fillPoints(sheet, results, unit, actions) {
  const rows = sheet.measures.flatMap((measure, m) =>
    measure.points.map(({ name, pixel }, n) => {
      const measured = results[m].measured[n];
      const spread = measured.point && deviationsOf(measured);
      const key = `${m}-${n}`;
      const set = (axis) => (text) => actions.movePoint(m, n, axis, Number(text));
      const numbers = { type: "number", step: "any" };
      return element("tr", { class: sheet.chosen?.measure === m && sheet.chosen?.point === n ? "m-chosen" : "" }, [
        field(`name-${key}`, `Name of point ${name}`, name, (text) => actions.renamePoint(m, n, text), {
          maxlength: 300,
        }),
        field(`u-${key}`, `u of ${name}`, Number(pixel[0].toFixed(3)), set(0), numbers),
        field(`v-${key}`, `v of ${name}`, Number(pixel[1].toFixed(3)), set(1), numbers),
        ...[0, 1, 2].map((i) =>
          spread
            ? numberCell(placeText(measured.point[i], spread[i]), {
                value: measured.point[i],
                deviation: spread[i],
              })
            : numberCell("–", {}),
        ),
        element("td", { class: "m-remark", text: remarksOf([measured], [measured]) }),
        deleteCell(`gone-${key}`, `Delete point ${name}`, () => actions.deletePoint(m, n)),
      ]);
    }),
  );
  refill(byId("m-points"), rows);
  byId("m-points-title").hidden = rows.length === 0;
  for (const button of ["m-copy-csv", "m-copy-json", "m-clear"]) byId(button).disabled = rows.length === 0;
}

const WANTED = {
  length: ["Click two points.", "Click the other end."],
  angle: ["Click an end, the corner, and the other end.", "Click the corner of the angle.", "Click the other end."],
  area: ["Click the corners, one after the other.", "Click the next corner.", "Click the next corner."],
  point: ["Click a point."],
};

// The measure that is chosen, or the last one.
function fillAnswer(sheet, results, unit) {
  const index = sheet.chosen ? sheet.chosen.measure : sheet.measures.length - 1;
  const measure = sheet.measures[index];
  const show = (what, value, interval, note) => {
    for (const [id, text] of Object.entries({ what, value, interval, note })) {
      if (byId(`m-${id}`).textContent !== text) byId(`m-${id}`).textContent = text;
    }
  };
  if (!measure || (sheet.prompted && !sheet.chosen)) return show(TITLES[sheet.tool], "–", WANTED[sheet.tool][0], "");
  const { quantities, measured } = results[index];
  if (measure.kind === "point") {
    const { point } = measured[0];
    const spread = point && deviationsOf(measured[0]);
    const lines = point
      ? "xyz".split("").map((axis, i) => `${axis} ${withDeviation(point[i], spread[i], unit ?? "")}`)
      : ["–"];
    return show(measure.name, lines[0], lines.slice(1).join(", "), remarksOf(measured, measured));
  }
  if (!quantities.length)
    return show(measure.name, "–", WANTED[measure.kind][measure.points.length] ?? "", remarksOf(measured));
  const [main, second] = quantities;
  const its = unitOf(main.what, unit);
  const more = second ? ` Perimeter ${withDeviation(second.value, second.deviation, unitOf("perimeter", unit))}.` : "";
  const interval = Number.isNaN(main.value) ? "" : `95 %: ${intervalText(main, its)}.${more}`;
  return show(measure.name, withDeviation(main.value, main.deviation, its), interval, remarksOf(measured, quantities));
}

function equationOf({ normal, offset }) {
  const terms = ["x", "y", "z"].map((axis, i) => [normal[i], axis]).filter(([factor]) => factor);
  const text = terms.map(([factor, axis], n) => {
    const sign = factor < 0 ? (n ? " − " : "−") : n ? " + " : "";
    return `${sign}${Math.abs(factor) === 1 ? "" : `${plainNumber(Math.abs(factor))} `}${axis}`;
  });
  return `${text.join("")} = ${plainNumber(offset + 0)}`;
}

const INCLUDED = {
  camera:
    "The deviations hold the noise of your clicks, and what the calibration leaves open: focal lengths, principal point, lens and the pose, together.",
  pose: "The deviations hold the noise of your clicks and of the pose. The camera itself counts as exact, for it came without its uncertainty.",
  pixels: "The deviations hold the noise of your clicks alone: the camera came without its uncertainty.",
};

function fillFacts(data, scene) {
  byId("m-doubts").hidden = !data.model.doubts;
  byId("m-doubts").textContent = `Doubtful: ${data.model.doubts}`;
  const [width, height] = data.size;
  const reduced =
    data.shown[0] < width
      ? ` It is shown from ${data.shown[0]} × ${data.shown[1]} px; coordinates are those of the original.`
      : "";
  const facts = [
    INCLUDED[data.model.includes],
    `You measure on the plane ${equationOf(scene.map.plane)}${data.unit ? `, in ${data.unit}` : ", in the calibration's unit"}: what does not lie in it reads wrong. Its own place counts as exact.`,
    data.model.region ? "Hatched: no corner of the calibration lay there, and only the lens model tells the lens." : "",
    "Dark: no point of the plane, beyond the horizon or the lens.",
    `The photograph has ${width} × ${height} px; 0, 0 is the middle of its first pixel.${reduced}`,
    "All of this runs in this file: nothing is loaded, and nothing is sent.",
  ];
  byId("m-facts").replaceChildren(...facts.filter(Boolean).map((text) => element("li", { text })));
}
