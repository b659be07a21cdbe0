"""Makes the fixtures of tests.tiny_models available to the tests of this folder."""

from tests.tiny_models import *  # noqa: F403
