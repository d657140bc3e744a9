"""Arrays that grow row by row."""

import numpy as np


class Table:
    """Columns of equal length that grow together; a column is read as an attribute and is a view of the rows in use.

    A view taken before an `append` may be of memory that is no longer the table's: take it anew after growing.
    """

    def __init__(self, **columns: tuple):
        """Take each column as ``name=(dtype, *row_shape)``."""
        self._columns = {name: np.empty((256, *shape), dtype=dtype) for name, (dtype, *shape) in columns.items()}
        self._n = 0

    def __len__(self) -> int:
        return self._n

    def __getattr__(self, name: str) -> np.ndarray:
        try:
            return self.__dict__["_columns"][name][: self._n]
        except KeyError:
            raise AttributeError(name) from None

    def append(self, n: int, **values: object) -> slice:
        """Add `n` rows with a value or an array for each column; returns where they are."""
        if set(values) != set(self._columns):
            raise TypeError(f"columns {sorted(set(values) ^ set(self._columns))} are missing or unknown")
        rows = slice(self._n, self._n + n)
        for name, column in self._columns.items():
            if rows.stop > len(column):
                grown = np.empty((max(rows.stop, 2 * len(column)), *column.shape[1:]), dtype=column.dtype)
                grown[: self._n] = column[: self._n]
                self._columns[name] = column = grown
            column[rows] = values[name]
        self._n = rows.stop
        return rows
