"""Names and values that somebody may have meant badly, and what a page looks like to a parser."""

from html.parser import HTMLParser

HOSTILE = (
    "<script>alert(1)</script>",
    "</script><script>alert(1)</script>",
    "</SCRIPT >",
    "</style><style>*{display:none}</style>",
    "<!--",
    "--><script>alert(1)</script>",
    "<!--<script>",
    "]]>",
    "<![CDATA[x]]>",
    "<?xml version='1.0'?>",
    '"><img src=x onerror=alert(1)>',
    "'><img src=x onerror=alert(1)>",
    '" onmouseover="alert(1)',
    "' onmouseover='alert(1)",
    "` onmouseover=`alert(1)",
    "<img src=https://example.org/x.png>",
    "<link rel=stylesheet href=https://example.org/x.css>",
    "<iframe src=https://example.org></iframe>",
    "<base href=https://example.org>",
    "<meta http-equiv=refresh content=0;url=https://example.org>",
    "<svg onload=alert(1)>",
    "<svg><animate onbegin=alert(1)>",
    "<math><mi xlink:href=javascript:alert(1)>",
    "<a href=javascript:alert(1)>x</a>",
    "javascript:alert(1)",
    "data:text/html,<script>alert(1)</script>",
    "<form action=https://example.org><input>",
    "<object data=x></object>",
    "<template><script>alert(1)</script></template>",
    "<title>x</title></title>",
    "</title><script>alert(1)</script>",
    "</main></body></html>",
    "<textarea>",
    "<plaintext>",
    "<details open ontoggle=alert(1)>",
    "&lt;script&gt;",
    "&#60;script&#62;",
    "&quot;&apos;&amp;",
    "{{ 7 * 7 }}",
    "{% for x in () %}",
    "{{ config.__class__ }}",
    "${7*7}",
    "<%= 7 * 7 %>",
    "__proto__",
    "constructor",
    "toString",
    "hasOwnProperty",
    "\u2028alert(1)\u2029",
    "\u202egnp.exe\u202c",
    "\u2066left\u2069 \u200fright",
    "a\u0000b",
    "a\x1b[31mb\x07",
    "line\r\nbreak\ttab",
    "\ufeff\u200b\u200d",
    "../../etc/passwd",
    "..\\..\\windows",
    "file:///etc/passwd",
    "//example.org/x",
    "CON",
    "%00%3Cscript%3E",
    "\\u003cscript\\u003e",
    '\\"};alert(1);//',
    "'; DROP TABLE worlds; --",
    "$(touch x) `touch x` ; touch x",
    "\uff21\uff22 \ufe64script\ufe65 测试 ✓",
    "🚗" * 40,
    "x" * 5_000,
)
UNSEEN = {
    chr(c) for c in (*range(9), *range(11, 32), *range(127, 160), 0x61C, 0x200B, 0x200E, 0x200F, 0x2028, 0x2029, 0xFEFF)
}
UNSEEN |= {chr(c) for c in (*range(0x202A, 0x202F), *range(0x2066, 0x206A))}
_VOID = {"meta", "img", "input", "br", "hr"}


class Page(HTMLParser):
    """Tags with their attributes, and the text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "wbr":  # where a line may be broken: neither a part of the page nor of the text
            assert not attrs
            self.words = self.words.removesuffix(" ")
            return
        self.tags.append((tag, dict(attrs)))
        if tag not in _VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.words += data + " "

    @property
    def text(self) -> str:
        return " ".join(self.words.split())

    @property
    def shape(self) -> list[tuple[str, list[str]]]:
        """Every tag with the names of its attributes: what a hostile text must not change."""
        return [(tag, sorted(attributes)) for tag, attributes in self.tags]
