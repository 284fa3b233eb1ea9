"""The faults of `mutation.py` fit the source, and what was noticed is on record."""

import json

from mutation import FAULTS, RESULT, ROOT, SOURCE, tests_of


def test_every_fault_fits_the_source():
    for fault in FAULTS:
        text = (ROOT / SOURCE / fault.file).read_text()
        assert text.count(fault.old) == 1, fault
        assert fault.old != fault.new
        for name in tests_of(fault.file):
            assert (ROOT / "tests" / name).exists(), name


def test_nearly_all_faults_have_been_noticed():
    result = json.loads(RESULT.read_text())
    assert result["of"] >= 40
    assert result["noticed"] >= 0.9 * result["of"]
