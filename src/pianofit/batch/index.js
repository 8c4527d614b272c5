// Sorts the table of keys by the column whose header is pressed. A second press reverses the order.
(() => {
  for (const table of document.querySelectorAll("table.sortable")) {
    const body = table.tBodies[0], heads = [...table.querySelectorAll("th[aria-sort]")];
    const value = (row, column) => { // NaN without a value
      const text = row.cells[column].dataset.value;
      return text ? Number(text) : NaN;
    };
    function sort(head) {
      const order = head.getAttribute("aria-sort") === "ascending" ? "descending" : "ascending", sign = order === "ascending" ? 1 : -1;
      const rows = [...body.rows].map((row) => [row, value(row, head.cellIndex)]);
      rows.sort(([, a], [, b]) => Number.isNaN(a) - Number.isNaN(b) || sign * (a - b) || 0); // rows without a value come last
      body.append(...rows.map(([row]) => row));
      heads.forEach((other) => other.setAttribute("aria-sort", other === head ? order : "none"));
    }
    heads.forEach((head) => head.querySelector("button").addEventListener("click", () => sort(head)));
  }
})();
