-- Where the trace of a job goes on: the W3C traceparent of the call that created it; empty where nobody traces.
ALTER TABLE jobs ADD COLUMN trace TEXT NOT NULL DEFAULT '';

-- How many jobs wait, and since when: answered from the index alone.
CREATE INDEX jobs_queue ON jobs (state, priority, owner, queued_ms) WHERE state = 'QUEUED';
