"""The landscapes of `calibray.optimizers.landscapes`, under the name that the tests of the optimizers import."""

from calibray.optimizers.landscapes import *  # noqa: F403
