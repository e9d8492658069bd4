import pickle

import numpy as np
import pytest

from pcr_mpc import ConvergenceError, ModelError, PCRError, UnreachableError
from pcr_mpc.errors import checked_array


def test_errors_survive_pickling_with_their_evidence():
    error = ConvergenceError("did not converge", residual=1e-3, iterations=7, last=[1.0])
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is ConvergenceError
    assert (str(copy), copy.residual, copy.iterations, copy.last) == ("did not converge", 1e-3, 7, [1.0])


def test_unknown_attributes_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = UnreachableError("x").nothing


def test_wrong_files_are_value_errors():
    assert issubclass(ModelError, ValueError)
    assert issubclass(ModelError, PCRError)


def test_infinities_of_both_signs_are_refused_without_a_warning():
    with pytest.raises(ValueError, match="wanted is not finite"):
        checked_array("wanted", np.array([[np.inf], [-np.inf]]), (2, 1))
    assert checked_array("huge", np.array([1e300]), (1,))[0] == 1e300  # its square overflows, it does not
