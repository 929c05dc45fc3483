# SPDX-License-Identifier: Apache-2.0
"""The program ``ros2``, which Ctrl-C ends without a traceback while it imports."""
# built in, unlike the module signal: any other import may be interrupted
import _signal  # type: ignore[import-not-found]

_DEFAULT = _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler
if _DEFAULT:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)

from ros2cli import cli  # noqa: E402 - after the signal


def main() -> object:
    """Call the command line; return what ``sys.exit()`` takes."""
    try:
        if _DEFAULT:
            _signal.signal(_signal.SIGINT, _signal.default_int_handler)
        return cli.main()
    except KeyboardInterrupt:
        return int(_signal.SIGINT)
