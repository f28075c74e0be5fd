# SPDX-License-Identifier: Apache-2.0
"""Parts of a run are kept without pickle, and read back as they were."""

import pickle

import numpy as np
import pytest

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import saved_results
from musculoskeletal_ae.experiments.recording import Motion


def test_values_are_read_back_as_they_were(tmp_path):
    rng, file = np.random.default_rng(0), tmp_path / 'part.npz'
    motion = Motion(rng.normal(size=(3, 2)), rng.normal(size=(3, 6)).astype(np.float32))
    share = float(rng.uniform())
    saved_results.write(
        file, {'motions': {'arm': motion}, 'laps': [(np.arange(3), None, 'a')], 'x': share}
    )
    read = saved_results.read(file)
    np.testing.assert_array_equal(read['motions']['arm'].theta, motion.theta)
    assert read['motions']['arm'].tension.dtype == np.float32
    ((numbers, nothing, text),) = read['laps']
    assert numbers.tolist() == [0, 1, 2] and nothing is None and text == 'a'
    assert read['x'] == share


@pytest.mark.parametrize('value', [{1: 'a'}, [np.array([None])], {'a': object()}])
def test_what_would_need_pickle_is_not_written(tmp_path, value):
    with pytest.raises(TypeError):
        saved_results.write(tmp_path / 'part.npz', value)


class Code:
    def __reduce__(self):
        return exec, ('raise AssertionError("code of a file ran")',)


@pytest.mark.parametrize('kind', ['pickle', 'objects', 'array', 'text', 'other keys', 'document'])
def test_other_files_are_refused_and_their_code_is_not_run(tmp_path, kind):
    file = tmp_path / 'part.npz'
    with file.open('wb') as stream:
        if kind == 'pickle':
            pickle.dump(Code(), stream)
        elif kind == 'objects':
            np.savez(stream, document=np.array([Code()]))
        elif kind == 'array':
            np.save(stream, np.zeros(3))
        elif kind == 'text':
            stream.write(b'no file of numpy')
        elif kind == 'other keys':
            np.savez(stream, np.zeros(3))
        else:
            np.savez(stream, document=np.array('{"module": "os"}'))
    with pytest.raises(MusculoskeletalError, match=r'part.npz is no kept part.*remove it'):
        saved_results.read(file)
