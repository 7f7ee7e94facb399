"""Pickled arrays without their danger: only numpy's own types are made, nothing else is run."""

import _codecs
import io
import pickle
from typing import Any

import numpy as np
from numpy._core import multiarray, numeric

_DTYPE_CLASSES = {value for value in vars(np.dtypes).values() if isinstance(value, type)}
NUMPY_GLOBALS = {
    np.ndarray,
    np.dtype,
    multiarray._reconstruct,
    multiarray.scalar,
    numeric._frombuffer,
    _codecs.encode,
    *_DTYPE_CLASSES,
}
_BY_NAME = {(item.__module__, item.__qualname__): item for item in NUMPY_GLOBALS}
_BY_NAME |= {("numpy", "ndarray"): np.ndarray, ("numpy", "dtype"): np.dtype, ("_codecs", "encode"): _codecs.encode}
for _package in ("numpy.core", "numpy._core"):  # files of numpy 1 and 2 name the same functions differently
    _BY_NAME |= {
        (f"{_package}.multiarray", "_reconstruct"): multiarray._reconstruct,
        (f"{_package}.multiarray", "scalar"): multiarray.scalar,
        (f"{_package}.numeric", "_frombuffer"): numeric._frombuffer,
    }


class _ArrayUnpickler(pickle.Unpickler):
    """Refuses every class and function but numpy's."""

    def find_class(self, module: str, name: str) -> Any:
        found = _BY_NAME.get((module, name))
        if found is None:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return found


def load_object_array(data: bytes, where: str) -> Any:
    """The one object in an .npy file of type object (a dictionary of arrays, say).

    Raises:
        ValueError: for a truncated file, another type of array, or a pickle that asks for anything but numpy arrays.
    """
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        _, _, dtype = read_header(file)
        if dtype != np.dtype(object):
            raise ValueError(f"an array of {dtype}")
        return _ArrayUnpickler(file, encoding="latin1").load().item()
    except (pickle.UnpicklingError, ValueError, EOFError, AttributeError, KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"load_object_array(): expected a dictionary of plain arrays in {where}; got: {error}. Copy the file again."
        ) from error
