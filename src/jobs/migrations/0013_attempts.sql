-- What became of each attempt: kept as long as its job.
CREATE TABLE attempts (
    job        TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    epoch      INTEGER NOT NULL,
    attempt    INTEGER NOT NULL,
    -- The incarnation, and the host that it ran on.
    worker     TEXT    NOT NULL,
    host       TEXT    NOT NULL,
    started_ms INTEGER NOT NULL,
    ended_ms   INTEGER,
    -- How it ended: a code, and a sentence for people.
    reason     TEXT    NOT NULL DEFAULT '',
    detail     TEXT    NOT NULL DEFAULT '',
    -- 1 when the loss speaks against the job, or the host.
    counts     INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (job, epoch)
) STRICT, WITHOUT ROWID;

CREATE INDEX attempts_against ON attempts (host, ended_ms) WHERE counts = 1;

INSERT INTO attempts (job, epoch, attempt, worker, host, started_ms)
SELECT id, epoch, attempt, worker, worker, COALESCE(started_ms, created_ms) FROM jobs WHERE state = 'RUNNING';

-- Where workers run: a row for each host that has asked for a job.
CREATE TABLE workers (
    host                 TEXT    PRIMARY KEY,
    -- The incarnation that was last heard of, its version, and when that was.
    worker               TEXT    NOT NULL,
    version              TEXT    NOT NULL,
    seen_ms              INTEGER NOT NULL,
    -- Losses up to then do not speak against it: it has done a job since, or somebody has vouched for it.
    sound_ms             INTEGER NOT NULL DEFAULT 0,
    -- Gets no jobs before then, for this reason.
    quarantined_until_ms INTEGER NOT NULL DEFAULT 0,
    why                  TEXT    NOT NULL DEFAULT '',
    -- An administrator wants it to work no more.
    drained              INTEGER NOT NULL DEFAULT 0
) STRICT;
