// What the page shows stands in its address: a reload, a shared link and the back button return.

export function read() {
  const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
  const [place = "", name = ""] = path.split("/");
  return { place, name: decodeURIComponent(name), ...Object.fromEntries(new URLSearchParams(query)) };
}

export function write({ place, name, ...rest }, { replace = false } = {}) {
  const kept = Object.entries(rest).filter(([, value]) => value !== "" && value != null);
  const query = new URLSearchParams(kept).toString();
  const path = name ? `${place}/${encodeURIComponent(name)}` : place;
  const hash = `#/${path}${query ? `?${query}` : ""}`;
  if (hash === location.hash) return;
  if (replace) {
    history.replaceState(null, "", hash);
    dispatchEvent(new Event("popstate"));
  } else location.hash = hash;
}
