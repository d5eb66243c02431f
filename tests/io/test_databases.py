"""COLMAP databases of other programs: nothing is written beside them, and their size bounds the work."""

import os
import sqlite3
from contextlib import closing

import numpy as np
import pytest

from tests.conftest import refuses
from thesisrecon.errors import UsageError
from thesisrecon.io._colmap import read_database

PAIR = 2**31 - 1
TABLES = {
    "cameras": "camera_id INTEGER, model INTEGER, width, height",
    "images": "image_id INTEGER, name, camera_id INTEGER",
    "keypoints": "image_id INTEGER, rows, cols, data",
    "two_view_geometries": "pair_id, rows, cols, data",
    "matches": "pair_id, rows, cols, data",
}
ODD = ("9e999", "1e300", "0", "-1", "NULL", "'wide'", "x'00'", "9223372036854775807")
ENDLESS = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n)"


def database(path, *changes, without=""):
    """Two images with five keypoints and their matches; ``changes`` are SQL statements."""
    base = sqlite3.connect(path)
    for name, columns in TABLES.items():
        if name != without:
            base.execute(f"CREATE TABLE {name} ({columns})")
    rows = [("cameras", (7, 0, 640, 480)), ("images", (1, "a/1.jpg", 7)), ("images", (2, "2.jpg", 7))]
    xy = np.arange(10, dtype="<f4").tobytes()
    rows += [("keypoints", (image, 5, 2, xy)) for image in (1, 2)]
    rows.append(("matches", (PAIR + 2, 5, 2, np.repeat(np.arange(5, dtype="<u4"), 2).tobytes())))
    for table, row in rows:
        if table != without:
            base.execute(f"INSERT INTO {table} VALUES ({','.join('?' * len(row))})", row)
    for change in changes:
        base.execute(change)
    base.commit()
    return base


@pytest.mark.parametrize("unfinished", [False, True], ids=["closed", "with a log"])
def test_a_database_with_a_log_of_changes_is_read_and_its_folder_left_alone(tmp_path, unfinished):
    path = tmp_path / "wal.db"
    with closing(database(path, "PRAGMA user_version = 1")) as base:
        base.execute("PRAGMA journal_mode = WAL")
        base.execute("PRAGMA wal_autocheckpoint = 0")
        base.execute("UPDATE cameras SET width = 700")
        base.commit()
        if unfinished:
            (tmp_path / "copy").mkdir()
            for file in (path, tmp_path / "wal.db-wal"):
                (tmp_path / "copy" / file.name).write_bytes(file.read_bytes())
    path = tmp_path / "copy" / "wal.db" if unfinished else path
    before = {file.name: file.read_bytes() for file in path.parent.iterdir() if file.is_file()}
    assert ("wal.db-wal" in before) == unfinished
    path.parent.chmod(0o555)
    try:
        found = read_database(path)
    finally:
        path.parent.chmod(0o755)
    assert found.names == ["2.jpg", "a/1.jpg"]
    assert found.sizes.tolist() == [[700, 480]] * 2
    assert {file.name: file.read_bytes() for file in path.parent.iterdir() if file.is_file()} == before


def test_an_interrupted_change_is_said_and_an_ended_one_is_no_obstacle(tmp_path):
    database(tmp_path / "base.db").close()
    journal = tmp_path / "base.db-journal"
    journal.write_bytes(bytes(512))
    assert len(read_database(tmp_path / "base.db").names) == 2
    journal.write_bytes(bytes.fromhex("d9d505f920a163d7") + bytes(504))
    refuses(UsageError, "interrupted change in base.db-journal", read_database, tmp_path / "base.db")


@pytest.mark.parametrize("table", [*TABLES])
@pytest.mark.parametrize("kind", ["view", "generated", "virtual"])
def test_tables_whose_rows_are_computed_are_refused(tmp_path, table, kind):
    path, columns = tmp_path / "bomb.db", [column.split()[0] for column in TABLES[table].split(", ")]
    if kind == "view":
        values = ", ".join(f"zeroblob(1000000000) AS {column}" for column in columns)
        made = f"CREATE VIEW {table} AS {ENDLESS} SELECT {values} FROM n"
    elif kind == "generated":
        own = ", ".join([*columns[:-1], f"{columns[-1]} AS (zeroblob(100000000))"])
        made = f"CREATE TABLE {table} ({own})"
    else:
        made = f"CREATE VIRTUAL TABLE {table} USING fts3({', '.join(columns)})"
    database(path, made, without=table).close()
    refuses(UsageError, f"no stored table {table}", read_database, path)


def test_rows_that_claim_more_than_the_file_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "more.db"
    database(path, "UPDATE keypoints SET data = zeroblob(5000000), rows = 625000").close()
    assert len(read_database(path).keypoints[0]) == 625_000
    # The second image shares the pages of the first.
    monkeypatch.setattr("thesisrecon.io._colmap._states", lambda _: [(6_000_000, 0)])
    refuses(UsageError, "table keypoints claims more data than the file holds", read_database, path)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        *((f"UPDATE cameras SET {side} = {value}", "the sides must be whole numbers from 1 to 16777216")
          for side in ("width", "height") for value in ODD),
        *((f"UPDATE keypoints SET {what}", "the keypoints of .* claim")
          for what in ("rows = -1", "rows = 4e9", "rows = 'x'", "cols = 0", "cols = 1, rows = 10",
                       "data = NULL", "data = 'abc'", "rows = 9223372036854775807")),
        ("UPDATE keypoints SET data = x'" + "0000c07f" * 10 + "'", "the keypoints of .* are not finite"),
        *((f"UPDATE matches SET {what}", "the matches of .* claim")
          for what in ("rows = 6", "rows = 5.0", "cols = 3", "data = NULL")),
        *((f"UPDATE matches SET pair_id = {pair}", "of images that are missing")
          for pair in ("'x'", "-5", "1e300", "NULL", "9223372036854775807")),
        *((f"UPDATE images SET name = {name}", "an image name must be a relative path")
          for name in ("NULL", "x'ff'", "17", "''", "'/etc/' || image_id", "'../' || image_id")),
        ("UPDATE images SET name = 'same.jpg'", "holds 'same.jpg' twice"),
        ("UPDATE images SET camera_id = 8", "refers to a missing camera"),
        ("DELETE FROM matches", "holds no matches; run COLMAP's matcher first$"),
        ("DELETE FROM images", "holds no images"),
    ],
)  # fmt: skip
def test_values_that_cannot_be_are_one_sentence(tmp_path, change, sentence):
    database(tmp_path / "odd.db", change).close()
    refuses(UsageError, sentence, read_database, tmp_path / "odd.db")


def test_a_database_that_changes_meanwhile_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "busy.db"
    database(path).close()
    monkeypatch.setattr("thesisrecon.io._colmap._read_tables", lambda *_: os.utime(path, ns=(1, 1)))
    refuses(UsageError, "was changed while it was read", read_database, path)
