"""Content-Security-Policy headers of the studio's responses."""

from avmsf.export.policy import directives_of, policy_text

_FRAMES = {"frame-ancestors": ["'none'"]}
"""Directive that is valid only in a header."""
NOTHING = policy_text({"default-src": ["'none'"], **_FRAMES})
"""Policy of all responses that are not the page: they may run nothing if opened as a page."""


def policy_of(page: str) -> str:
    """Return the Content-Security-Policy of the page's HTML."""
    return policy_text({**directives_of(page), **_FRAMES})
