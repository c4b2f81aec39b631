// Charts as pictures, and the numbers behind them: whatever page they are on, a click saves them.

export function download(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

function picture(svg, name, scale = 2) {
  const box = svg.viewBox.baseVal;
  const copy = svg.cloneNode(true);
  copy.setAttribute("width", box.width);
  copy.setAttribute("height", box.height);
  const image = new Image();
  image.onload = () => {
    const canvas = document.createElement("canvas");
    canvas.width = box.width * scale;
    canvas.height = box.height * scale;
    const context = canvas.getContext("2d");
    context.fillStyle = "#ffffff";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.drawImage(image, 0, 0, canvas.width, canvas.height);
    canvas.toBlob((blob) => download(`${name}.png`, blob));
  };
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(new XMLSerializer().serializeToString(copy))}`;
}

// A figure bears its numbers, and what it is of is said by what it stands in.
addEventListener("click", ({ target }) => {
  const button = target.closest?.("[data-save]");
  const figure = button?.closest("figure[data-csv]");
  if (!figure) return;
  const svg = figure.querySelector("svg");
  const words = [figure.closest("[data-of]")?.dataset.of ?? "pemviz", svg.getAttribute("aria-label")];
  const name = words.join(" ").replace(/[^\p{L}\p{N}.-]+/gu, "-").slice(0, 120).replace(/-+$/, "");
  if (button.dataset.save === "png") picture(svg, name);
  else download(`${name}.csv`, new Blob([figure.dataset.csv], { type: "text/csv;charset=utf-8" }));
});
