-- The second input, for jobs that have one. First, as it wants the table for itself.
ALTER TABLE jobs ADD COLUMN simplified TEXT;

UPDATE jobs SET simplified = spec /*pg ::json */ -> 'simplified' ->> 'mesh';

-- Which jobs name a mesh is asked for every mesh that nobody has used for long.
CREATE INDEX jobs_by_mesh ON jobs (mesh);

CREATE INDEX jobs_by_simplified ON jobs (simplified);
