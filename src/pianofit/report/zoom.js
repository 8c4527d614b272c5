// A button on every picture opens it in a dialog, where buttons, keys and the mouse wheel change its scale.
(() => {
  const STEP = 1.25, LEAST = 1, MOST = 8; // step and limits of the scale; 1 shows the whole picture
  const dialog = document.createElement("dialog");
  dialog.innerHTML = '<div class="controls"><button type="button" class="less" aria-label="Smaller">−</button>' +
    '<button type="button" class="more" aria-label="Larger">+</button><span class="scale" role="status"></span>' +
    '<button type="button" class="close">Close</button></div><div class="sheet" tabindex="0" role="region" aria-label="Picture"></div>';
  const find = (selector) => dialog.querySelector(selector), sheet = find(".sheet");
  let drawing = null, frame = null, scale = 1;

  function fit() { // width, px, at which the whole picture is visible
    const box = drawing.querySelector("svg").viewBox.baseVal;
    return Math.min(sheet.clientWidth, (sheet.clientHeight * box.width) / box.height);
  }

  function resize(to, at = { x: sheet.clientWidth / 2, y: sheet.clientHeight / 2 }) { // the point `at` keeps its position
    const before = scale;
    scale = Math.min(MOST, Math.max(LEAST, to));
    const ratio = scale / before, left = (sheet.scrollLeft + at.x) * ratio - at.x, top = (sheet.scrollTop + at.y) * ratio - at.y;
    drawing.style.width = scale * fit() + "px";
    sheet.scrollTo(left, top);
    find(".scale").textContent = Math.round(100 * scale) + " %";
  }

  function open(panel) {
    frame = panel;
    drawing = panel.querySelector(".drawing");
    panel.style.minHeight = panel.offsetHeight + "px"; // so that the page does not scroll
    sheet.append(drawing);
    dialog.setAttribute("aria-label", drawing.getAttribute("aria-label"));
    dialog.showModal();
    scale = 1;
    resize(1);
    sheet.focus();
  }

  function put() { // move the picture back to the page
    drawing.style.width = "";
    frame.prepend(drawing);
    frame.style.minHeight = "";
    drawing = null;
  }

  const keys = { "+": STEP, "=": STEP, "-": 1 / STEP };
  dialog.addEventListener("keydown", (event) => {
    event.stopPropagation(); // otherwise the players would react to the keys
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys || event.key === "0")) return;
    event.preventDefault();
    resize(event.key === "0" ? 1 : scale * keys[event.key]);
  });
  sheet.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = sheet.getBoundingClientRect();
    resize(scale * (event.deltaY < 0 ? STEP : 1 / STEP), { x: event.clientX - box.left, y: event.clientY - box.top });
  }, { passive: false });
  dialog.addEventListener("close", put);
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  find(".close").addEventListener("click", () => dialog.close());
  find(".more").addEventListener("click", () => resize(scale * STEP));
  find(".less").addEventListener("click", () => resize(scale / STEP));
  addEventListener("resize", () => drawing && resize(scale));
  document.body.append(dialog);
  for (const panel of document.querySelectorAll(".panel")) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "zoom";
    button.textContent = "Enlarge";
    button.setAttribute("aria-label", "Enlarge: " + panel.querySelector(".drawing").getAttribute("aria-label"));
    button.addEventListener("click", () => open(panel));
    panel.append(button);
  }
})();
