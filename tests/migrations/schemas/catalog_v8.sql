BEGIN TRANSACTION;
CREATE TABLE "_sqlite_migrations" (
   "id" INTEGER PRIMARY KEY,
   "migration_set" TEXT,
   "name" TEXT,
   "applied_at" TEXT
);
INSERT INTO "_sqlite_migrations" VALUES(1,'deepsimbad_catalog','m001_domains_maps_jobs','2026-11-22 02:15:08.869995+00:00');
INSERT INTO "_sqlite_migrations" VALUES(2,'deepsimbad_catalog','m002_keys_served_times_job_starts','2026-11-22 04:55:00.225798+00:00');
INSERT INTO "_sqlite_migrations" VALUES(3,'deepsimbad_catalog','m003_row_checksums','2026-11-22 05:46:17.438476+00:00');
INSERT INTO "_sqlite_migrations" VALUES(4,'deepsimbad_catalog','m004_without_owners_and_row_checksums','2026-11-28 14:05:04.708106+00:00');
INSERT INTO "_sqlite_migrations" VALUES(5,'deepsimbad_catalog','m005_domains_of_keys','2026-11-28 14:49:59.373528+00:00');
INSERT INTO "_sqlite_migrations" VALUES(6,'deepsimbad_catalog','m006_options_of_domains','2026-11-29 00:50:00.000000+00:00');
INSERT INTO "_sqlite_migrations" VALUES(7,'deepsimbad_catalog','m007_maps_shared_as_objects','2026-11-29 12:58:43.196180+00:00');
INSERT INTO "_sqlite_migrations" VALUES(8,'deepsimbad_catalog','m008_administrator_of_a_data_directory','2026-11-30 00:28:00.000000+00:00');
CREATE TABLE api_key (
            key_id TEXT NOT NULL PRIMARY KEY,
            name TEXT NOT NULL,
            scope TEXT NOT NULL CHECK (scope IN ('localize', 'admin')),
            secret_sha256 TEXT NOT NULL,
            created_at TEXT NOT NULL,
            expires_at TEXT,
            revoked_at TEXT
        , domains TEXT);
INSERT INTO "api_key" VALUES('0123456789ab','robot 7','localize','abababababababababababababababababababababababababababababababab','2026-11-20T10:00:00.000Z',NULL,NULL,'["campus"]');
CREATE TABLE domain (
            name TEXT NOT NULL PRIMARY KEY,
            evaluator TEXT NOT NULL,
            closed INTEGER NOT NULL CHECK (closed IN (0, 1)),
            actions_m TEXT NOT NULL,
            next_version INTEGER NOT NULL DEFAULT 1,
            created_at TEXT NOT NULL
        , options TEXT NOT NULL DEFAULT '{}', shared INTEGER NOT NULL DEFAULT 0);
INSERT INTO "domain" VALUES('campus','{"extractor":"none","kind":"feature_l2"}',1,'[1.0,2.0,3.0]',2,'2026-11-22T02:15:08.871Z','{"thumbnails":true}',1);
CREATE TABLE doomed_folder (domain TEXT NOT NULL PRIMARY KEY);
CREATE TABLE job (
            job_id TEXT NOT NULL PRIMARY KEY,
            domain TEXT NOT NULL REFERENCES domain (name) ON DELETE CASCADE,
            kind TEXT NOT NULL,
            config TEXT NOT NULL,
            state TEXT NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
            stage TEXT,
            progress REAL NOT NULL DEFAULT 0 CHECK (progress BETWEEN 0 AND 1),
            eta_s REAL,
            result TEXT,
            error TEXT,
            created_at TEXT NOT NULL,
            started_at TEXT,
            finished_at TEXT
        , n_starts INTEGER NOT NULL DEFAULT 0);
INSERT INTO "job" VALUES('74fe615e9f68f270036158b556090ad6','campus','remap','{"seed":0}','succeeded','done',1.0,NULL,'{"map_version":1}',NULL,'2026-11-22T02:15:08.988Z','2026-11-22T02:15:08.988Z','2026-11-22T02:15:08.988Z',2);
CREATE TABLE map (
            domain TEXT NOT NULL REFERENCES domain (name) ON DELETE CASCADE,
            version INTEGER NOT NULL CHECK (version >= 1),
            state TEXT NOT NULL CHECK (state IN ('building', 'sealed', 'active', 'retired')),
            created_at TEXT NOT NULL,
            sha256 TEXT,
            file_bytes INTEGER,
            config TEXT NOT NULL,
            metrics TEXT NOT NULL, activated_at TEXT, retired_at TEXT, removed_at TEXT, shared INTEGER NOT NULL DEFAULT 0,
            PRIMARY KEY (domain, version),
            CHECK (state = 'building' OR (sha256 IS NOT NULL AND file_bytes IS NOT NULL))
        );
INSERT INTO "map" VALUES('campus',1,'active','2026-11-22T02:15:08.872Z','1ab66c4b2a65f8a66286ab466929afd1306ccb7e11f184c28ade9a47895b2ff2',69632,'{"list_length":2,"n_landmarks":3}','{"anr":4.5}','2026-11-20T10:00:00.000Z',NULL,NULL,1);
CREATE TABLE map_store (
            id INTEGER PRIMARY KEY CHECK (id = 1),
            url TEXT NOT NULL,
            store_id TEXT NOT NULL,
            position INTEGER NOT NULL
        , administrator INTEGER NOT NULL DEFAULT 0);
INSERT INTO "map_store" VALUES(1,'s3://maps/fleet','0123456789abcdef0123456789abcdef',7,2);
CREATE UNIQUE INDEX "idx__sqlite_migrations_migration_set_name"
    ON "_sqlite_migrations" ("migration_set", "name");
CREATE UNIQUE INDEX map_one_active ON map (domain) WHERE state = 'active';
CREATE INDEX job_domain ON job (domain);
COMMIT;
