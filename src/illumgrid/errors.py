"""What went wrong, said in one sentence: what came, what was expected, what to do."""


class BadInput(ValueError):
    """The caller's input cannot be used; the message says what came, what was expected and what to do."""


class IllumgridWarning(UserWarning):
    """The result stands, but it is worth knowing this about it."""
