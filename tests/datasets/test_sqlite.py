"""Connections to SQLite files: one for each thread, closed when the thread or the owner goes."""

import gc
import sqlite3
import threading
from pathlib import Path

import pytest

from slamcli.datasets import open_dataset
from slamcli.datasets.sqlite import Connections
from slamcli.errors import SlamError


@pytest.fixture
def file(tmp_path: Path) -> Path:
    connection = sqlite3.connect(tmp_path / "a.db")
    connection.execute("CREATE TABLE t (x)")
    connection.commit()
    connection.close()
    return tmp_path / "a.db"


def is_open(connection: sqlite3.Connection) -> bool:
    try:
        connection.execute("SELECT x FROM t")
    except sqlite3.ProgrammingError:
        return False
    return True


def test_a_thread_keeps_its_connection_until_the_owner_goes(file: Path) -> None:
    connections = Connections(file)
    held = connections.of_this_thread()
    assert connections.of_this_thread() is held and is_open(held)
    del connections
    gc.collect()
    assert not is_open(held)


def test_a_thread_has_a_connection_of_its_own_that_ends_with_it(file: Path) -> None:
    connections, found = Connections(file), []
    thread = threading.Thread(target=lambda: found.append(connections.of_this_thread()))
    thread.start()
    thread.join()
    gc.collect()
    assert found[0] is not connections.of_this_thread()
    assert not is_open(found[0]) and is_open(connections.of_this_thread())


ENDLESS = "WITH RECURSIVE c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c)"
COMPUTED = {
    "a view without end": f"CREATE VIEW Node AS {ENDLESS} SELECT id, 1.0 AS stamp, x'' AS ground_truth_pose FROM c",
    "a view that finds nothing, without end": f"CREATE VIEW schema AS {ENDLESS} SELECT id AS schema_version FROM c WHERE id < 0",
    "a generated column": "CREATE TABLE Data (id INTEGER, image AS (hex(zeroblob(200000000))), depth BLOB, calibration BLOB)",
    "a virtual table": "CREATE VIRTUAL TABLE Data USING fts5(id, image, depth, calibration)",
}
BAG = """
CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);
"""


@pytest.mark.parametrize("kind", COMPUTED)
@pytest.mark.parametrize("name", ["rtabmap.db", "bag.db3"])
def test_a_file_that_computes_what_it_holds_is_refused_before_it_does(tmp_path: Path, name: str, kind: str) -> None:
    connection = sqlite3.connect(tmp_path / name)
    connection.executescript(BAG if name == "bag.db3" else "CREATE TABLE Admin (version TEXT)")
    connection.executescript(COMPUTED[kind])
    connection.commit()
    connection.close()
    with pytest.raises(SlamError, match="is computed, not stored"):
        open_dataset(str(tmp_path / name))
