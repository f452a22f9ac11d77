"""Files that are no log to be read: one line that says what they are, and what makes a table of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.fantwin_command import error_of

PRODUCT = b"H Product:Blackbox flight data recorder by Nicholas Sherlock\nH Data version:2\n"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.bbl", PRODUCT, "a blackbox log, which is not read as it is: `blackbox_decode a.bbl` writes a table"),
        ("a.txt", b"\0\xff\x13rest of another log" + PRODUCT, "a blackbox log"),
        ("a.TXT", b"OpenLog started\r\n" + PRODUCT, "a blackbox log"),
        ("within.BBL", b"I\x01\xff\x80P\x03" * 50, "a blackbox log"),
        (
            "a.bin",
            b"\xa3\x95\x80\x80\x59FMT\0",
            "`mavlogdump.py --format csv --types ESC a.bin` and `--types RCOU` write",
        ),
        ("a.log", b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n", "a dataflash log of ArduPilot"),
        ("a.tlog", b"\0\x05\xee\xa0\x1c\x20\x11\x04\xfd\x09\0", "a telemetry log of MAVLink"),
        ("a.xlsx", b"PK\x03\x04\x14\0", "save the sheet as CSV"),
        ("a.csv.gz", b"\x1f\x8b\x08\0\0", "decompress it first"),
        ("a.parquet", b"PAR1\x15\x04", "`pandas.read_parquet('a.parquet').to_csv('a.parquet.csv')` makes a table"),
        ("a.mat", b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "`writetable` in MATLAB makes a CSV file"),
        ("b.mat", b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
        ("a.mf4", b"MDF     4.10    ", "the program `asammdf` exports it as CSV"),
        ("a.tdms", b"TDSm\x0e\0\0\0", "`TdmsFile.read('a.tdms').as_dataframe()` of nptdms makes a table"),
        ("a.db3", bytes(4096), "`sqlite3 a.db3 .recover | sqlite3 FIXED.db3` may save it"),
        ("a.dat", bytes(range(256)) * 9, "not a text file with columns, a ULog or a ROS bag; export it as CSV"),
    ],
)
def test_a_file_of_another_format_is_named_with_what_converts_it(
    tmp_path: Path, name: str, content: bytes, said: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    for words in (("--preview",), ("--command", "a", "--speed", "b", "-o", tmp_path / "r.mcap")):
        assert said in error_of("import", path, *words)
