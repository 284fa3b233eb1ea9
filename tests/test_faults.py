"""The faults of `mutation.py` fit the source, and what was noticed is on record."""

import json

import mutation


def test_every_fault_fits_the_source():
    for fault in mutation.FAULTS:
        text = (mutation.ROOT / mutation.SOURCE / fault.file).read_text()
        assert text.count(fault.old) == 1, fault
        assert fault.old != fault.new
        for name in mutation.tests_of(fault.file):
            assert (mutation.ROOT / "tests" / name).exists(), name


def test_nearly_all_faults_have_been_noticed():
    result = json.loads(mutation.RESULT.read_text())
    assert result["of"] >= 40
    assert result["noticed"] >= 0.9 * result["of"]
