-- The order of the queue: priority, then the owner that has had least, then age.
ALTER TABLE jobs ADD COLUMN priority INTEGER NOT NULL DEFAULT 0;

-- Since when it waits.
ALTER TABLE jobs ADD COLUMN queued_ms INTEGER NOT NULL DEFAULT 0;

-- 1 when a job of higher priority waits for the worker of this one.
ALTER TABLE jobs ADD COLUMN preempt INTEGER NOT NULL DEFAULT 0;

UPDATE jobs SET queued_ms = created_ms;

CREATE INDEX jobs_waiting ON jobs (priority, owner, n) WHERE state = 'QUEUED';

CREATE INDEX jobs_running ON jobs (owner, priority) WHERE state = 'RUNNING';

-- What owners have had of the workers' time: a logarithm (store/queue.rs).
CREATE TABLE shares (
    owner TEXT PRIMARY KEY,
    score REAL NOT NULL
) STRICT;
