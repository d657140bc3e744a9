"""Connections to SQLite files: one for each thread, closed when the thread or the owner goes."""

import gc
import sqlite3
import threading
from pathlib import Path

import pytest

from slamcli.datasets.sqlite import Connections


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
