// The table of keys is sorted by the column whose header is pressed; pressed again, the other way around.
(() => {
  for (const table of document.querySelectorAll("table.sortable")) {
    const body = table.tBodies[0], heads = [...table.querySelectorAll("th[aria-sort]")];
    const value = (row, column) => { // NaN where there is none
      const text = row.cells[column].dataset.value;
      return text ? Number(text) : NaN;
    };
    function sort(head) {
      const way = head.getAttribute("aria-sort") === "ascending" ? "descending" : "ascending", sign = way === "ascending" ? 1 : -1;
      const rows = [...body.rows].map((row) => [row, value(row, head.cellIndex)]);
      rows.sort(([, a], [, b]) => Number.isNaN(a) - Number.isNaN(b) || sign * (a - b) || 0); // what has no value is last
      body.append(...rows.map(([row]) => row));
      heads.forEach((one) => one.setAttribute("aria-sort", one === head ? way : "none"));
    }
    heads.forEach((head) => head.querySelector("button").addEventListener("click", () => sort(head)));
  }
})();
