"use strict";
// The table of models: rows with the words of the search, and with errors only.
for (const tools of document.querySelectorAll(".tools[data-filters]")) {
  const rows = [...document.querySelectorAll(`#${tools.dataset.filters} [data-find]`)];
  const search = tools.querySelector("input[type=search]"), failing = tools.querySelector("input[type=checkbox]");
  const count = tools.querySelector("output");
  const show = () => {
    const words = search.value.toLowerCase().split(/\s+/);
    let shown = 0;
    for (const row of rows) {
      const text = row.dataset.find.toLowerCase();
      const fits = words.every((word) => text.includes(word)) && !(failing.checked && "clean" in row.dataset);
      row.classList.toggle("hidden", !fits);
      const section = document.getElementById(row.dataset.section);
      if (section) section.classList.toggle("hidden", !fits);
      shown += fits;
    }
    count.textContent = `${shown} of ${rows.length}`;
  };
  search.addEventListener("input", show);
  failing.addEventListener("change", show);
  tools.hidden = false;
  show();
}
// All parts of the page open or closed, and open for paper.
const fold = (open) => document.querySelectorAll("details").forEach((one) => (one.open = open));
for (const button of document.querySelectorAll("button[data-fold]")) {
  button.addEventListener("click", () => fold(button.dataset.fold === "open"));
  button.hidden = false;
}
addEventListener("beforeprint", () => fold(true));
// A map shows the module that was chosen in its whole width: by a click on its tile, or in the list beside the map.
for (const map of document.querySelectorAll(".map")) {
  const back = document.querySelector(`button[data-back="${map.id}"]`);
  const zoom = (tile) => {
    for (const one of map.querySelectorAll(".tile")) one.classList.toggle("out", !(one.contains(tile) || tile.contains(one)));
    back.hidden = tile.parentElement === map;
  };
  const whole = () => zoom(map.firstElementChild);
  map.addEventListener("click", (event) => {
    const tile = event.target.closest(".tile");
    if (tile) zoom(tile);
  });
  back.addEventListener("click", whole);
  addEventListener("keydown", (event) => event.key === "Escape" && whole());
}
