-- Whose each thing is. What was made before there were owners is the local user's.
ALTER TABLE jobs ADD COLUMN owner TEXT NOT NULL DEFAULT 'local';

CREATE INDEX jobs_by_owner ON jobs (owner, n);

-- A request's name is its owner's own: jobs.request_id, unique among all, is no longer written.
CREATE TABLE requests (
    owner      TEXT NOT NULL,
    request_id TEXT NOT NULL,
    job        TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    PRIMARY KEY (owner, request_id)
);

CREATE INDEX requests_by_job ON requests (job);

INSERT INTO requests (owner, request_id, job)
SELECT owner, request_id, id FROM jobs WHERE request_id IS NOT NULL;

UPDATE jobs SET request_id = NULL;

-- The bytes of a mesh are stored once; who uploaded them may use them.
CREATE TABLE mesh_owners (
    owner TEXT NOT NULL,
    mesh  TEXT NOT NULL REFERENCES meshes (hash) ON DELETE CASCADE,
    PRIMARY KEY (owner, mesh)
);

CREATE INDEX mesh_owners_by_mesh ON mesh_owners (mesh);

INSERT INTO mesh_owners (owner, mesh) SELECT 'local', hash FROM meshes;

-- Who did what, and who was refused. The id grows with time.
CREATE TABLE audit (
    id        TEXT   PRIMARY KEY,
    at_ms     BIGINT NOT NULL,
    principal TEXT   NOT NULL,
    owner     TEXT   NOT NULL,
    peer      TEXT   NOT NULL,
    method    TEXT   NOT NULL,
    resource  TEXT   NOT NULL,
    outcome   TEXT   NOT NULL
);

CREATE INDEX audit_by_time ON audit (at_ms);
