from tests.docs import layout


def test_page_of_the_layout__is_made_of_the_code() -> None:
    assert layout.PAGE.read_text("utf-8") == layout.page()
