"use strict";
(() => {
  const articles = [...document.querySelectorAll("article[data-batch]")];
  const select = document.getElementById("pick");
  if (select) {
    const previous = document.getElementById("previous");
    const next = document.getElementById("next");
    const show = (announce) => {
      const index = select.selectedIndex;
      articles.forEach((article, i) => { article.hidden = i !== index; });
      previous.disabled = index <= 0;
      next.disabled = index >= articles.length - 1;
      if (announce) {
        document.getElementById("picked").textContent = "Showing batch " + select.options[index].textContent;
      }
    };
    const move = (step) => { select.selectedIndex += step; show(true); };
    select.addEventListener("change", () => show(true));
    previous.addEventListener("click", () => move(-1));
    next.addEventListener("click", () => move(1));
    document.getElementById("picker").hidden = false;
    show(false);
  }

  const key = (row, column) => row.cells[column].dataset.v;
  for (const table of document.querySelectorAll("table.sortable")) {
    const headings = [...table.tHead.rows[0].cells];
    headings.forEach((heading, column) => {
      heading.querySelector("button").addEventListener("click", () => {
        const up = heading.getAttribute("aria-sort") !== "ascending";
        const rows = [...table.tBodies[0].rows].map((row) => [key(row, column), row]);
        // Rows without a value stay last whichever way the others run.
        rows.sort(([a], [b]) => (a === "" || b === "" ? (a === "") - (b === "") : (up ? 1 : -1) * (Number(a) - Number(b))));
        headings.forEach((other) => other.removeAttribute("aria-sort"));
        heading.setAttribute("aria-sort", up ? "ascending" : "descending");
        table.tBodies[0].append(...rows.map(([, row]) => row));
      });
    });
  }
})();
