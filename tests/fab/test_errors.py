"""Messages as a terminal shows them, whatever the names and values in them."""

import pytest

from fab.errors import CheckFailed, InputError, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("lens \u00b5m \u2264 1\u00a0%", "lens \u00b5m \u2264 1\u00a0%"),
        ("\x1b[2Jall passed", "\\x1b[2Jall passed"),
        ("a\rb\x07\x9b1m", "a\\rb\\x07\\x9b1m"),
        ("a\nb", "a\\nb"),
        ("\u202egpj.exe", "\\u202egpj.exe"),
        ("caf\udce9.toml", "caf\\udce9.toml"),
    ],
)
def test_what_a_terminal_would_obey_is_shown_instead(text: str, shown: str):
    assert printable(text) == shown
    assert printable(text, "\n") == (text if text == "a\nb" else shown)
    assert str(InputError(text, "must be plain", text, "Rename it.")) == (
        f"{shown}: must be plain, but got {shown}. Rename it."
    )
    assert str(CheckFailed([text, text])) == f"{shown}\n{shown}"


def test_a_long_value_is_shown_by_its_beginning():
    message = str(InputError("a", "must be short", "x" * 10**6, "Shorten it."))
    assert message.endswith("xxx... (1000000 characters). Shorten it.")
    assert len(message) < 1100
