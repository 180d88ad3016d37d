"""Attacks on what Calibray wrote itself: path files, kept traces, ledgers and results."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np

from calibray.engines.ledger.database import LedgerEntry
from calibray.fields import path_loss
from calibray.paths import seal
from calibray.paths.file_format import BLOCK
from calibray.study import Study
from fuzzing import world
from fuzzing.mutations import NUMBERS, TEXTS, damage, edited, hostile
from fuzzing.outcome import Case
from fuzzing.world import OWN, World


def paths(rng: Random, found: World, folder: Path) -> Case:
    """A path file with bytes changed, or a field of it changed and sealed again."""
    file = folder / "paths.h5"
    shutil.copyfile(found.base / "paths.h5", file)
    if rng.random() < 0.4:
        file.write_bytes(damage(rng, file.read_bytes()))
        return Case("paths", "bytes", lambda: world.loss(file), True, names=("paths.h5",))
    if rng.random() < 0.3:
        raw = bytearray(file.read_bytes())
        for _ in range(rng.choice((1, 1, 2, 8))):
            raw[rng.randrange(BLOCK, len(raw))] ^= 1 << rng.randrange(8)
        file.write_bytes(raw)
        try:
            seal(file)
        except Exception:  # the HDF5 library itself is used to seal
            return Case(
                "paths", "bits, cannot be sealed", lambda: world.loss(file), True, names=("paths.h5",)
            )
        return Case("paths", "bits, sealed", lambda: world.loss(file), names=("paths.h5",), own=OWN)
    note, bad = _field(rng, file)
    return Case("paths", note, lambda: world.loss(file), bad, names=("paths.h5",), own=OWN)


def _field(rng: Random, file: Path) -> tuple[str, bool]:
    """Change a dataset or an attribute, and seal the file again."""
    with h5py.File(file, "r+") as content:
        names: list[str] = []
        content.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        name, bad = rng.choice(sorted(names)), False
        array = content[name][()]
        match rng.randrange(6):
            case 0:
                key = rng.choice(sorted(content.attrs))
                value = rng.choice((*NUMBERS[:8], *TEXTS[:8], np.zeros(3), np.nan))
                note = f"attribute {key} = {str(value)[:40]!r}"
                try:
                    content.attrs[key] = value
                except (TypeError, ValueError, OverflowError):
                    content.attrs[key] = "x"
            case 1:
                del content[name]
                note, bad = f"without {name}", True
            case 2:
                shape = rng.choice([(0,), (), (*array.shape, 2), array.shape[::-1], (array.size + 1,)])
                del content[name]
                content[name] = np.resize(array, shape) if array.dtype != object else "x"
                note = f"{name} of shape {shape}"
            case 3:
                kind = rng.choice(("f4", "i8", "u1", "c16", "S5", "?"))
                del content[name]
                content[name] = np.zeros(array.shape, kind)
                note = f"{name} of {kind}"
            case _:
                note = name
                if array.dtype == object:
                    array[...] = rng.choice((b"", b"x", b"walls", "é".encode(), b"\xff"))
                elif array.size:
                    place = tuple(rng.randrange(size) for size in array.shape)
                    value = rng.choice((np.nan, np.inf, -1, 10**6, 2**31 - 1, -(2**31), 1e300, 0, 7))
                    if array.dtype.kind in "iu":
                        value = 99 if isinstance(value, float) else value
                        value = max(
                            min(value, int(np.iinfo(array.dtype).max)), int(np.iinfo(array.dtype).min)
                        )
                    with np.errstate(over="ignore"):
                        array[place] = value
                    note, bad = f"{name} = {value}", isinstance(value, float) and not np.isfinite(value)
                content[name][...] = array
    seal(file)
    return f"sealed, {note}", bad


def cache(rng: Random, found: World, folder: Path) -> Case:
    """A kept trace that is damaged: dropped, and traced again."""
    study = found.copy(folder)
    (folder / "cache").mkdir()
    entries = sorted(found.base.with_name("cache").glob("*.h5"))
    sealed, note = rng.random() < 0.4, "bytes"
    for entry in entries:
        target = folder / "cache" / entry.name
        shutil.copyfile(entry, target)
        state = rng.getstate()
        if sealed:
            note, _ = _field(rng, target)
        else:
            target.write_bytes(damage(rng, target.read_bytes()))
        rng.setstate(state)

    def act() -> list[float]:
        os.environ["CALIBRAY_CACHE"] = str(folder / "cache")
        setup = Study.load(study).opened()
        return np.asarray(path_loss(setup.trace())).tolist()

    right = None if sealed else found.right["path_loss"]
    return Case("cache", note, act, expected=right, own=(*OWN, "cache"))


def ledger(rng: Random, found: World, folder: Path) -> Case:
    """A ledger with bytes, tables or entries changed: what is damaged is dropped, and asked for again."""
    study = found.copy(folder, "paid")
    file, right, bad = folder / "paid" / "ledger.sqlite", {"rmse_db": found.right["ledger"]}, False
    match rng.randrange(4):
        case 0:
            file.write_bytes(damage(rng, file.read_bytes()))
            note = "bytes"
        case 1:
            beside = folder / "paid" / f"ledger.sqlite{rng.choice(('-wal', '-journal', '-shm'))}"
            beside.write_bytes(rng.randbytes(rng.choice((1, 32, 5000))))
            note = beside.name
        case 2:
            note = _schema(rng, file)
        case _:
            note, trusted = _entry(rng, file)
            right = None if trusted else right
    if rng.random() < 0.4:
        arguments: tuple[object, ...] = (folder / "paid",)
        if rng.random() < 0.5:
            arguments += ("-o", folder / rng.choice(("calls.csv", "calls.parquet")))
        if rng.random() < 0.3:
            arguments += ("--forget-failed",)
        return Case(
            "ledger",
            f"list, {note}",
            lambda: world.calibray("ledger", *arguments),
            own=(*OWN, "paid", "calls."),
        )

    def act() -> Any:
        errors = world.rmse(study, "-o", folder / "paid", "--engine", "command")
        return {"rmse_db": errors["rmse_db"]}

    return Case("ledger", f"run, {note}", act, bad, right, own=(*OWN, "paid"))


def _schema(rng: Random, file: Path) -> str:
    change = rng.choice(
        (
            "DROP TABLE answers",
            "DROP TABLE problems",
            "DROP TABLE claims",
            "PRAGMA user_version = 3",
            "PRAGMA user_version = 1",
            "PRAGMA user_version = 0",
            "PRAGMA user_version = -7",
            "ALTER TABLE answers ADD COLUMN more TEXT",
            "ALTER TABLE answers RENAME COLUMN failure TO fault",
            "ALTER TABLE answers DROP COLUMN time",
            "CREATE TRIGGER t BEFORE INSERT ON answers BEGIN SELECT RAISE(ABORT, 'no'); END",
            "CREATE TRIGGER t AFTER INSERT ON answers BEGIN DELETE FROM answers; END",
            "ALTER TABLE answers RENAME TO old",
            "CREATE TABLE other (x)",
            "PRAGMA application_id = 7",
            "DELETE FROM problems",
            "DELETE FROM answers",
            "INSERT INTO claims SELECT problem, candidate, 'x', 'y', 1e300 FROM answers LIMIT 1",
            "PRAGMA journal_mode = delete",
            "PRAGMA encoding = 'UTF-16'",
            "PRAGMA auto_vacuum = 1",
        )
    )
    with sqlite3.connect(file) as connection:
        try:
            connection.execute(change)
        except sqlite3.Error as error:
            return f"{change}: {error}"
    connection.close()
    return change


def _entry(rng: Random, file: Path) -> tuple[str, bool]:
    """Change an entry; whether it vouches for itself nevertheless."""
    with sqlite3.connect(file) as connection:
        run = connection.execute
        rows = run("SELECT id, problem, candidate, path_loss_db, seconds, failure FROM answers").fetchall()
        number, problem, candidate, blob, *_ = rng.choice(rows)
        column = rng.choice(("path_loss_db", "seconds", "failure", "candidate", "digest", "time", "problem"))
        value = rng.choice(
            (
                b"",
                b"\0" * 8,
                blob[:-8],
                blob + blob,
                np.full(len(blob) // 8, np.nan).tobytes(),
                -1.0,
                float("inf"),
                2**60,
                "x",
                "y" * 10**6,
                damage(rng, blob),
                np.full(len(blob) // 8, -500.0).tobytes(),
                np.frombuffer(blob).tolist()[0],
            )
        )
        try:
            run(f"UPDATE answers SET {column} = ? WHERE id = ?", (value, number))
            if again := rng.random() < 0.4:
                found = run(
                    "SELECT path_loss_db, seconds, failure FROM answers WHERE id = ?", (number,)
                ).fetchone()
                if isinstance(found[0], bytes) and len(found[0]) % 8 == 0:
                    entry = LedgerEntry(np.frombuffer(found[0], "<f8"), found[1], str(found[2]))
                    run(
                        "UPDATE answers SET digest = ? WHERE id = ?",
                        (entry.digest(problem, candidate), number),
                    )
        except sqlite3.Error as error:
            return f"{column}: {error}", False
    connection.close()
    return f"{column} = {str(value)[:40]!r}{', digest renewed' * again}", again


def result(rng: Random, found: World, folder: Path) -> Case:
    """A result's folder, or what was calibrated, changed before it is used to predict."""
    found.copy(folder, "out")
    out, signed, bad, right = folder / "out", rng.random() < 0.3, False, found.right["predicted"]
    match rng.randrange(6):
        case 0 | 1 | 2:
            content, note, senseless = edited(rng, json.loads((out / "result.json").read_text()))
            try:
                (out / "result.json").write_bytes(json.dumps(content).encode(errors="surrogatepass"))
            except ValueError:
                (out / "result.json").write_text("1" * 5000)
            bad = senseless
        case 3:
            name = rng.choice(
                ("result.json", "result-links.csv", "result-history.csv", "result-scene.xml", ".calibray")
            )
            (out / name).write_bytes(damage(rng, (out / name).read_bytes()))
            note = f"bytes of {name}"
            signed &= name != ".calibray"
        case 4:
            name = rng.choice(("result-links.csv", "result-history.csv"))
            lines = (out / name).read_text().splitlines()
            row = rng.randrange(len(lines))
            cells = lines[row].split(",")
            cells[rng.randrange(len(cells))] = str(hostile(rng))[:1000]
            lines[row] = ",".join(cells)
            (out / name).write_text("\n".join(lines), errors="surrogatepass")
            note = f"{name}, line {row + 1}"
        case _:
            name = rng.choice(("scene.xml", "meshes/house.ply", "meshes/roof.obj", "horn.csv"))
            (folder / name).write_bytes(damage(rng, (folder / name).read_bytes()))
            note, bad, signed = f"bytes of {name}", True, False
    if signed:
        world.sign(out / "result.json")
        world.sign(out / "result-links.csv")
        note, right = f"{note}, signed", None
    table = folder / "new.csv"
    # What was calibrated wins over the study's table: files that predicting does not look at may change.
    return Case("result", note, lambda: world.predicted(out, table), bad, right, own=(*OWN, "out"))


KINDS = (paths, cache, ledger, result)
