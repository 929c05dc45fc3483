# SPDX-License-Identifier: Apache-2.0
"""The error of a launch file that can't be loaded."""
from typing import List, Optional


class InvalidLaunchFileError(Exception):
    """
    No loader could read the file.

    :param extension: the file's, empty where no loader claims it.
    :param likely_errors: what the loaders said, the likeliest first.
    """

    def __init__(
        self, extension: str = '', *, likely_errors: Optional[List[Exception]] = None
    ) -> None:
        self._extension = extension
        self._likely_errors = likely_errors
        if not extension or not likely_errors:
            text = 'The launch file may have a syntax error, or its format is unknown'
        else:
            kind = 'multiple exceptions' if len(likely_errors) > 1 else 'exception'
            text = '\n - '.join([
                f'Caught {kind} when trying to load file of format [{extension}]:',
                *(f'{type(error).__name__}: {error}' for error in likely_errors)])
            self.__cause__ = likely_errors[0]
        self._error_message = text
        super().__init__(text)

    def __str__(self) -> str:
        return self._error_message
