-- Results may have their time: pinned jobs keep them; swept is 1 when their rows are gone, 2 when their bytes are too.
ALTER TABLE jobs ADD COLUMN pinned INTEGER NOT NULL DEFAULT 0;

ALTER TABLE jobs ADD COLUMN swept INTEGER NOT NULL DEFAULT 0;

CREATE INDEX jobs_to_sweep ON jobs (ended_ms) WHERE swept < 2;
