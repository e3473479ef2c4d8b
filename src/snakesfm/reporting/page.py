"""The report's HTML: one self-contained file without scripts from elsewhere."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

Row = Sequence[Any]

TEMPLATE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ page.scene }} | snakesfm</title>
<style>
 :root { color-scheme: light dark; --line: #8883; --soft: #8888; --accent: #2a7f62; --bad: #c0392b; }
 body { font: 15px/1.5 system-ui, sans-serif; max-width: 1180px; margin: 2rem auto; padding: 0 1rem; }
 h1 { margin-bottom: 0; } h2 { margin-top: 2.2rem; border-bottom: 1px solid var(--line); }
 .lead { font-size: 1.15rem; margin-top: .3rem; } .note { opacity: .75; } .warn { color: var(--bad); }
 table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .6rem 0; }
 th, td { padding: .15rem .8rem .15rem 0; text-align: left; vertical-align: top; }
 th { border-bottom: 1px solid var(--soft); font-weight: 600; } td.n, th.n { text-align: right; }
 tbody tr:hover { background: var(--line); } tr.bad td { color: var(--bad); }
 .scroll { max-height: 32rem; overflow: auto; } .scroll th { position: sticky; top: 0; background: Canvas; }
 .side { display: flex; flex-wrap: wrap; gap: 1.5rem; } figure { margin: 0; flex: 1 1 22rem; }
 figcaption { opacity: .75; } .plot { width: 100%; height: auto; } .plot text { font-size: 11px;
 fill: currentColor; } .bar { fill: var(--accent); } .map { border: 1px solid var(--line); }
 .cameras path { fill: #e0483fcc; stroke: #7a130c; stroke-width: .6; } code { font-size: .9em; }
</style></head><body>
{%- macro cell(value) -%}
 {%- if value is none -%}-{%- elif value is string -%}{{ value }}
 {%- elif value is float -%}{{ "%.4g" | format(value) if value < 1000 else "{:,.0f}".format(value) }}
 {%- else -%}{{ "{:,}".format(value) }}{%- endif -%}
{%- endmacro %}
{%- macro table(heads, rows, limit=false) %}
<div class="{{ 'scroll' if limit }}"><table><thead><tr>
{%- for head in heads %}<th{% if rows and rows[0][loop.index0] is not string %} class="n"{% endif %}>
{{- head }}</th>{% endfor %}</tr></thead><tbody>
{%- for row in rows %}<tr>{% for value in row %}
{#- #}<td{% if value is not string %} class="n"{% endif %}>{{ cell(value) }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{%- endmacro %}
<h1>{{ page.scene }}</h1>
<p class="lead">{{ page.lead }}</p>
{% for line in page.warnings %}<p class="warn">{{ line }}</p>{% endfor %}
<h2>The scene</h2>
{% if page.maps %}<div class="side">
{% for caption, plot in page.maps %}<figure>{{ plot | safe }}<figcaption>{{ caption }}</figcaption></figure>
{% endfor %}</div>
<p class="note">Each triangle is a camera, its tip the centre; hover over it for the image's name.</p>
{% else %}<p>No image is registered.</p>{% endif %}
<h2>Stages</h2>
{{ table(page.stage_heads, page.stages) }}
{% for title, heads, rows in page.tables %}{% if rows %}
<h2>{{ title }}</h2>{{ table(heads, rows) }}{% endif %}{% endfor %}
{% if page.histogram %}<h2>Reprojection errors</h2>
<figure style="max-width: 36rem">{{ page.histogram | safe }}
<figcaption>{{ page.histogram_caption }}</figcaption></figure>{% endif %}
<h2>Images that are not registered</h2>
{% if page.missing %}{{ table(["image", "why"], page.missing, true) }}
{% else %}<p>None: every image has a pose.</p>{% endif %}
{% if page.refused %}<h2>Files that could not be used</h2>
{{ table(["file", "why"], page.refused, true) }}{% endif %}
<h2>Images</h2>
{% if page.images_note %}<p class="note">{{ page.images_note }}</p>{% endif %}
{{ table(page.image_heads, page.images, true) }}
<h2>Options</h2>
{% for stage, options in page.options.items() %}<details><summary>{{ stage }}</summary>
<code>{{ options }}</code></details>
{% endfor %}
<p class="note">Made by {{ page.software }}.</p>
</body></html>
"""


@dataclass(frozen=True)
class Page:
    """What the report shows; tables are heads and rows of text, numbers or None."""

    scene: str
    lead: str
    software: str
    stages: Sequence[Row]
    stage_heads: Sequence[str]
    images: Sequence[Row]
    image_heads: Sequence[str]
    warnings: Sequence[str] = ()
    maps: Sequence[tuple[str, str]] = ()
    tables: Sequence[tuple[str, Sequence[str], Sequence[Row]]] = ()
    histogram: str = ""
    histogram_caption: str = ""
    missing: Sequence[Row] = ()
    refused: Sequence[Row] = ()
    images_note: str = ""
    options: Mapping[str, str] = field(default_factory=dict)


def render_page(page: Page) -> str:
    """The page as HTML; every text is escaped, only the plots are markup."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined)
    return environment.from_string(TEMPLATE).render(page=page)
