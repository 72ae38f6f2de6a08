-- The objects that this database tells of, by the name that they carry: one row.
CREATE TABLE objects (
    one INTEGER PRIMARY KEY CHECK (one = 1),
    id  TEXT    NOT NULL
) STRICT;
