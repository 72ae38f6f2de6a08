-- The order of the queue: priority, then the owner that has had least, then age.
ALTER TABLE jobs ADD COLUMN priority INTEGER NOT NULL DEFAULT 0;

-- Since when it waits.
ALTER TABLE jobs ADD COLUMN queued_ms INTEGER NOT NULL DEFAULT 0;

-- 1 when a job of higher priority waits for the worker of this one.
ALTER TABLE jobs ADD COLUMN preempt INTEGER NOT NULL DEFAULT 0;

UPDATE jobs SET queued_ms = created_ms;

CREATE INDEX jobs_waiting ON jobs (state, priority, owner, n);

-- Jobs that were lost, few of them.
CREATE INDEX jobs_lost ON jobs (state, lost) WHERE lost > 0;

CREATE INDEX jobs_of_owner ON jobs (state, owner);

-- What owners have had of the workers' time: a logarithm (store/queue.rs).
CREATE TABLE shares (
    owner TEXT PRIMARY KEY,
    score REAL NOT NULL
) STRICT;
