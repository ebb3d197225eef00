"""The error that a user can correct. Any other exception is a bug."""

LONGEST = 1500  # characters of a message


class InputError(Exception):
    """The input is faulty. The message is one sentence: what is wrong, which input it is, and what to do.

    Quotations from damaged files are made safe for a terminal: no control characters, no endless lines.
    """

    def __init__(self, message: str = "") -> None:
        text = "".join(c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in str(message))
        super().__init__(text if len(text) <= LONGEST else text[: LONGEST // 2] + " … " + text[-LONGEST // 2 :])
