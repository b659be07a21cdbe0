"""The exceptions that a command shows as a sentence in place of a traceback."""


class UserError(Exception):
    """A mistake that a user can mend. Its text says what is wrong, where, and what to do."""


class SettingsError(UserError):
    """A mistake in a command's settings, found before it starts. One line a mistake."""
