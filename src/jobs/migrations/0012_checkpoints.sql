-- Pieces of the checkpoint of a job that has not ended: what its workers found out so far, in order. The bytes are
-- objects of the job, under the epoch that sent them.
CREATE TABLE checkpoints (
    job   TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    -- From 0, without gaps.
    n     INTEGER NOT NULL,
    epoch INTEGER NOT NULL,
    -- The last entry of the log before it.
    seq   INTEGER NOT NULL,
    size  INTEGER NOT NULL,
    -- Which build of the worker can go on from it.
    build TEXT    NOT NULL,
    PRIMARY KEY (job, n)
) STRICT, WITHOUT ROWID;
