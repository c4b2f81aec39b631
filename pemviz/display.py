"""How what a program holds shows itself in a notebook: which function draws which type.

The functions lie in parts that import the types, and are imported when a notebook asks.
"""

from importlib import import_module

VIEWS = {
    "RunResult": "pemviz.reports.notebook:result_html",
    "Estimate": "pemviz.reports.notebook:estimate_html",
    "Rollout": "pemviz.reports.notebook:rollout_html",
}


class ShownInNotebooks:
    """A type that a notebook shows as HTML (IPython asks ``_repr_html_``)."""

    def _repr_html_(self) -> str:
        """Itself as HTML; all that others wrote is escaped."""
        name = next(kind.__name__ for kind in type(self).__mro__ if kind.__name__ in VIEWS)
        module, function = VIEWS[name].split(":")
        return str(getattr(import_module(module), function)(self))
