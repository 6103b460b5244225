"""What the page may load and run, as the header of the studio's answers says it."""

from avmsf.export.policy import directives_of, policy_text

_FRAMES = {"frame-ancestors": ["'none'"]}
"""Only a header can say it."""
NOTHING = policy_text({"default-src": ["'none'"], **_FRAMES})
"""Of all that is no page: whoever opens it as one gets nothing to run."""


def policy_of(page: str) -> str:
    """Return the Content-Security-Policy of the page's HTML."""
    return policy_text({**directives_of(page), **_FRAMES})
