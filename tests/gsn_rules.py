"""What gsn2x asks of an argument, as its documentation states the checks V01 to V06 and C01 to C08.

gsn2x is a Rust program that no Python registry has; this is a plain checker in its place.
"""

import yaml

KINDS = (("CG", None), ("G", "Goal"), ("CSn", None), ("Sn", "Solution"), ("S", "Strategy"),
         ("C", "Context"), ("A", "Assumption"), ("J", "Justification"))  # fmt: skip
SUPPORTS = {"Goal", "Strategy", "Solution"}
AROUND = {"Context", "Assumption", "Justification"}
OWN = {"text", "supportedBy", "inContextOf", "undeveloped"}


class UniqueKeys(yaml.SafeLoader):
    """A YAML table names each element once."""

    def construct_mapping(self, node, deep=False):
        keys = [self.construct_object(key) for key, _ in node.value]
        assert len(keys) == len(set(keys)), "a key stands twice"
        return super().construct_mapping(node, deep)


def kind_of(name):
    return next((kind for prefix, kind in KINDS if name.startswith(prefix)), None)


def load(path):
    document = yaml.load(path.read_text(encoding="utf-8"), Loader=UniqueKeys)  # noqa: S506
    assert isinstance(document, dict)
    return document


def complaints(document):
    """Every rule that is broken, with its number."""
    referenced = set()
    for name, one in document.items():
        kind = kind_of(name)
        if kind is None:
            yield f"V01 {name}"
        supports, around = one.get("supportedBy", []), one.get("inContextOf", [])
        if kind in ("Goal", "Strategy"):
            if not supports and one.get("undeveloped") is not True:
                yield f"V02 {name}"
            if supports and one.get("undeveloped"):
                yield f"V03 {name}"
        elif supports or around:
            yield f"V04 {name}"
        for names, kinds in ((supports, SUPPORTS), (around, AROUND)):
            if not isinstance(names, list):
                yield f"C11 {name}"
            if len(set(names)) < len(names):
                yield f"V05 {name}"
            for other in names:
                referenced.add(other)
                if other == name:
                    yield f"V06 {name}"
                if other not in document:
                    yield f"C03 {name} {other}"
                elif kind_of(other) not in kinds:
                    yield f"V04 {name} {other}"
        for key, value in one.items():
            if key not in OWN and not isinstance(value, str):
                yield f"layer {name}.{key} is no text"
        if not isinstance(one.get("text"), str):
            yield f"{name} has no text"
    roots = [name for name in document if name not in referenced]
    if len(roots) != 1:
        yield f"C01 {roots}"
    elif kind_of(roots[0]) != "Goal":
        yield f"C02 {roots[0]}"
    else:
        yield from walked(document, roots[0])


def walked(document, root):
    """C04 and C08: no element is below itself, all are below the root."""
    seen, path, waiting = set(), [], [(root, False)]
    while waiting:
        name, is_left = waiting.pop()
        if is_left:
            path.remove(name)
            continue
        if name in path:
            yield f"C04 {name}"
            continue
        seen.add(name)
        path.append(name)
        waiting.append((name, True))
        one = document.get(name, {})
        below = [*one.get("supportedBy", []), *one.get("inContextOf", [])]
        waiting += [(other, False) for other in below]
    if set(document) - seen:
        yield f"C08 {sorted(set(document) - seen)}"
