"""Write tables (``Sheet``) as Markdown and LaTeX: pandas, which could do it, is not in the extra ``report``.

Only for tables of the reproduction, which have no sections and no cell with two lines.
"""

from __future__ import annotations

from ethbrake_marl.files.sheet import Sheet

LATEX = str.maketrans({
    **{character: rf"\{character}" for character in "&%$#_{}"}, "\\": r"\textbackslash{}", "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}", "²": "$^2$", "–": "--", "[": "{[}", "]": "{]}",
})  # fmt: skip


def sheet_texts(sheet: Sheet) -> list[list[str]]:
    """Texts of the headings, then of the cells of each row."""
    return [
        sheet.headings,
        *([cell.in_words for cell in row if not isinstance(cell, str)] for row in sheet.formatted_rows()),
    ]


def markdown(sheet: Sheet) -> str:
    """Table as Markdown, without its title and note."""
    heads, *rows = sheet_texts(sheet)
    rule = ["---" if column.text else "---:" for column in sheet.formats]
    escaped = [[text.replace("|", "\\|") for text in row] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in (heads, rule, *escaped))


def latex(sheet: Sheet) -> str:
    """Table as a LaTeX ``tabular`` that needs the package ``booktabs``, without its title and note."""
    heads, *rows = (" & ".join(text.translate(LATEX) for text in line) + r" \\" for line in sheet_texts(sheet))
    kinds = "".join("l" if column.text else "r" for column in sheet.formats)
    begin, end = [rf"\begin{{tabular}}{{{kinds}}}", r"\toprule"], [r"\bottomrule", r"\end{tabular}"]
    return "\n".join([*begin, heads, r"\midrule", *rows, *end])
