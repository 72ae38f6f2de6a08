-- Calls that tell somebody of the end of a job: a row for each job that has an address to be called.
CREATE TABLE webhooks (
    job      TEXT    PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    -- The same at each attempt, so that receivers know repetitions.
    id       TEXT    NOT NULL,
    url      TEXT    NOT NULL,
    -- When to call next; null until the job has ended, and again when there is nothing more to do.
    next_ms  INTEGER,
    attempts INTEGER NOT NULL DEFAULT 0,
    -- How the last attempt ended; DELIVERED in the end.
    outcome  TEXT    NOT NULL DEFAULT ''
) STRICT;

CREATE INDEX webhooks_due ON webhooks (next_ms) WHERE next_ms IS NOT NULL;
