-- What clients call their jobs by, as JSON; and row by row, to be searched.
ALTER TABLE jobs ADD COLUMN labels TEXT NOT NULL DEFAULT '{}';

CREATE TABLE labels (
    key   TEXT    NOT NULL,
    value TEXT    NOT NULL,
    n     INTEGER NOT NULL REFERENCES jobs (n) ON DELETE CASCADE,
    PRIMARY KEY (key, value, n)
) STRICT, WITHOUT ROWID;

CREATE INDEX labels_of_job ON labels (n);

-- Jobs have their time, too.
CREATE INDEX jobs_ended ON jobs (ended_ms) WHERE pinned = 0;
