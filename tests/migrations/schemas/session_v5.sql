BEGIN TRANSACTION;
CREATE TABLE "_sqlite_migrations" (
   "id" INTEGER PRIMARY KEY,
   "migration_set" TEXT,
   "name" TEXT,
   "applied_at" TEXT
);
INSERT INTO "_sqlite_migrations" VALUES(1,'deepsimbad_session','m001_sessions_and_journal','2026-11-22 03:34:06.033303+00:00');
INSERT INTO "_sqlite_migrations" VALUES(2,'deepsimbad_session','m002_clock','2026-11-22 05:06:54.495040+00:00');
INSERT INTO "_sqlite_migrations" VALUES(3,'deepsimbad_session','m003_row_checksums','2026-11-22 05:46:17.547478+00:00');
INSERT INTO "_sqlite_migrations" VALUES(4,'deepsimbad_session','m004_without_clock_and_row_checksums','2026-11-28 14:05:04.714469+00:00');
INSERT INTO "_sqlite_migrations" VALUES(5,'deepsimbad_session','m005_key','2026-11-28 14:59:09.677496+00:00');
CREATE TABLE journal (
            session INTEGER NOT NULL REFERENCES session (number) ON DELETE CASCADE,
            sequence INTEGER NOT NULL CHECK (sequence >= 1),
            kind TEXT NOT NULL CHECK (kind IN ('observation', 'prior')),
            written_at REAL NOT NULL,
            expires_at REAL NOT NULL,
            idempotency_key TEXT,
            request_digest BLOB,
            action_m REAL,
            action_std_m REAL,
            ranks BLOB,
            dissimilarities BLOB,
            encoding BLOB,
            position_m REAL,
            std_m REAL,
            CHECK ((idempotency_key IS NULL) = (request_digest IS NULL)),
            CHECK (kind = 'prior' OR (action_m IS NOT NULL AND ranks IS NOT NULL)),
            CHECK (kind = 'observation' OR (position_m IS NOT NULL AND std_m IS NOT NULL))
        );
INSERT INTO "journal" VALUES(1,1,'observation',1010.0,4610.0,'k1',X'0102',0.0,NULL,X'020005000500',NULL,NULL,NULL,NULL);
INSERT INTO "journal" VALUES(1,2,'prior',1020.0,4620.0,NULL,NULL,NULL,NULL,NULL,NULL,NULL,1.5,2.0);
INSERT INTO "journal" VALUES(1,3,'observation',1030.0,4630.0,NULL,NULL,3.0,0.5,X'060002000400',X'0000003F0000803E0000C03E',X'0000803F00000040',NULL,NULL);
CREATE TABLE session (
            number INTEGER PRIMARY KEY,
            session_id TEXT NOT NULL UNIQUE,
            domain TEXT NOT NULL,
            map_version INTEGER NOT NULL CHECK (map_version >= 1),
            map_sha256 TEXT NOT NULL,
            config TEXT NOT NULL,
            created_at REAL NOT NULL,
            expires_at REAL NOT NULL,
            ended_at REAL,
            ending TEXT CHECK (ending IN ('deleted', 'expired')), key_id TEXT,
            CHECK ((ended_at IS NULL) = (ending IS NULL))
        );
INSERT INTO "session" VALUES(1,'aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','campus',1,'ffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff','{"filter":"grid","seed":7}',1000.0,4600.0,NULL,NULL,'a1b2c3d4');
INSERT INTO "session" VALUES(2,'bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb','campus',1,'ffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff','{"filter":"particle","seed":8}',1001.0,4601.0,1040.0,'deleted',NULL);
CREATE TABLE snapshot (
            session INTEGER NOT NULL REFERENCES session (number) ON DELETE CASCADE,
            name TEXT NOT NULL,
            sequence INTEGER NOT NULL CHECK (sequence >= 1),
            dtype TEXT NOT NULL,
            shape TEXT NOT NULL,
            body BLOB NOT NULL,
            PRIMARY KEY (session, name)
        );
INSERT INTO "snapshot" VALUES(1,'mass',2,'<f8','[2]',X'000000000000D03F000000000000E83F');
INSERT INTO "snapshot" VALUES(1,'n_observations',2,'<i8','[]',X'0100000000000000');
CREATE TABLE true_positions (
            session INTEGER PRIMARY KEY REFERENCES session (number) ON DELETE CASCADE,
            received_at REAL NOT NULL,
            position_m BLOB NOT NULL
        );
INSERT INTO "true_positions" VALUES(1,1050.0,X'000000000000F03F0000000000001040');
CREATE UNIQUE INDEX "idx__sqlite_migrations_migration_set_name"
    ON "_sqlite_migrations" ("migration_set", "name");
CREATE INDEX session_ended ON session (ended_at);
CREATE UNIQUE INDEX journal_sequence ON journal (session, sequence);
CREATE UNIQUE INDEX journal_key ON journal (session, idempotency_key) WHERE idempotency_key IS NOT NULL;
COMMIT;
