// Buttons, fields, what is copied, and the beginning.
//
// Promises: what is copied holds all digits, with the plane and the noise that they were measured with.

// --------------------------------------------------------------------------------------------------- buttons and fields

function fitAgain() {
  fit(view);
  soon("view");
}

async function copy(text, what) {
  let copied = true;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = element("textarea", { "aria-hidden": "true", class: "m-hidden" });
    area.value = text;
    byId("measuring").append(area);
    area.select();
    copied = document.execCommand("copy");
    area.remove();
  }
  byId("m-copied").textContent = copied ? `Copied as ${what}.` : "The browser does not let this page copy.";
}

function exported() {
  const chosen = data.model.planes[Number(byId("m-plane").value)];
  const { normal, offset } = scene.map.plane;
  const plane = { name: chosen.name, normal, offset, height: Number(byId("m-height").value) };
  const context = {
    photograph: data.name,
    unit: data.unit,
    plane,
    pixel_sigma: scene.sigma,
    includes: data.model.includes,
    doubts: data.model.doubts,
  };
  return asDocument(sheet, scene, context);
}

const CLICKS = {
  "m-undo": () => doIt(undo),
  "m-redo": () => doIt(redo),
  "m-closer": () => zoomBy(1.25),
  "m-wider": () => zoomBy(0.8),
  "m-fit": fitAgain,
  "m-grid": () => toggle("grid"),
  "m-loupe": () => toggle("loupe"),
  "m-finish": () => doIt(finish),
  "m-copy-csv": () => copy(asTable(exported()), "CSV"),
  "m-copy-json": () => copy(JSON.stringify(exported(), null, 1), "JSON"),
  "m-clear": () =>
    doIt(() => {
      remember(sheet);
      sheet.measures = [];
      sheet.chosen = null;
    }),
};
for (const [id, listener] of Object.entries(CLICKS)) byId(id).addEventListener("click", listener);
for (const button of document.querySelectorAll("[data-tool]"))
  button.addEventListener("click", () => choose(button.dataset.tool));
for (const id of ["m-plane", "m-height", "m-sigma"]) byId(id).addEventListener("change", choosePlane);
byId("m-settings").addEventListener("submit", (event) => {
  event.preventDefault();
  choosePlane();
});

// ------------------------------------------------------------------------------------------------------------- beginning

const PLANE_NAMES = { board: "the board's face", given: "the given plane" };
byId("m-plane").append(
  ...data.model.planes.map(({ name, ...plane }, n) =>
    element("option", { value: n, text: `${PLANE_NAMES[name] ?? "the plane"}, ${equationOf(plane)}` }),
  ),
);
byId("m-height-unit").textContent = data.unit ? `, ${data.unit}` : "";
byId("m-sigma").value =
  Number(data.model.sigma.toPrecision(4)) === data.model.sigma ? data.model.sigma : String(data.model.sigma);
canvas.setAttribute("aria-label", `Photograph ${data.name}, to measure in`);

new ResizeObserver(() => {
  const height = Math.max(Math.min((canvas.clientWidth * data.size[1]) / data.size[0], 0.78 * window.innerHeight), 180);
  canvas.style.height = `${Math.round(height)}px`;
  if (view.fitted) fit(view);
  planPicture = null;
  soon("view", "plan");
}).observe(canvas.parentElement);
if (!image.complete) image.addEventListener("load", () => soon("view", "plan"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => soon("view", "plan"));
choosePlane();
