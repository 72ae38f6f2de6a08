-- Inputs, by content. The bytes are in the object directory.
CREATE TABLE meshes (
    hash       TEXT    PRIMARY KEY,
    size       INTEGER NOT NULL,
    created_ms INTEGER NOT NULL
) STRICT;

CREATE TABLE jobs (
    -- Order of creation; never reused, so that page tokens stay valid.
    n                INTEGER PRIMARY KEY AUTOINCREMENT,
    id               TEXT    NOT NULL UNIQUE,
    request_id       TEXT    UNIQUE,
    mesh             TEXT    NOT NULL REFERENCES meshes (hash),
    file_name        TEXT    NOT NULL,
    spec             TEXT    NOT NULL,
    state            TEXT    NOT NULL,
    -- The attempt: its number and lease epoch, who runs it, and until when unheard.
    attempt          INTEGER NOT NULL DEFAULT 0,
    epoch            INTEGER NOT NULL DEFAULT 0,
    worker           TEXT    NOT NULL DEFAULT '',
    lease_until_ms   INTEGER NOT NULL DEFAULT 0,
    -- Lost attempts that count towards POISONED.
    lost             INTEGER NOT NULL DEFAULT 0,
    cancel_requested INTEGER NOT NULL DEFAULT 0,
    -- The log: its last number, and how many entries the current attempt has sent.
    last_seq         INTEGER NOT NULL DEFAULT 0,
    appended         INTEGER NOT NULL DEFAULT 0,
    failure_reason   TEXT    NOT NULL DEFAULT '',
    failure_text     TEXT    NOT NULL DEFAULT '',
    stage            TEXT    NOT NULL DEFAULT '',
    fraction         REAL    NOT NULL DEFAULT 0,
    created_ms       INTEGER NOT NULL,
    started_ms       INTEGER,
    ended_ms         INTEGER
) STRICT;

CREATE INDEX jobs_by_state ON jobs (state, n);

CREATE TABLE events (
    job            TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    seq            INTEGER NOT NULL,
    epoch          INTEGER NOT NULL,
    at_ms          INTEGER NOT NULL,
    body           TEXT    NOT NULL,
    -- Where the bytes of a record chunk are: a segment file, and the range in it once unpacked.
    segment        TEXT,
    segment_offset INTEGER,
    segment_len    INTEGER,
    PRIMARY KEY (job, seq)
) STRICT, WITHOUT ROWID;

CREATE TABLE artifacts (
    job        TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    epoch      INTEGER NOT NULL,
    file       TEXT    NOT NULL,
    media_type TEXT    NOT NULL,
    size       INTEGER NOT NULL,
    blake3     TEXT    NOT NULL,
    PRIMARY KEY (job, epoch, file)
) STRICT, WITHOUT ROWID;
