BEGIN TRANSACTION;
CREATE TABLE "_sqlite_migrations" (
   "id" INTEGER PRIMARY KEY,
   "migration_set" TEXT,
   "name" TEXT,
   "applied_at" TEXT
);
INSERT INTO "_sqlite_migrations" VALUES(1,'deepsimbad_traverse','m001_frames','2026-11-22 02:15:08.990255+00:00');
INSERT INTO "_sqlite_migrations" VALUES(2,'deepsimbad_traverse','m002_weights','2026-11-28 10:56:11.525625+00:00');
INSERT INTO "_sqlite_migrations" VALUES(3,'deepsimbad_traverse','m003_without_checksums','2026-11-28 14:05:04.716823+00:00');
INSERT INTO "_sqlite_migrations" VALUES(4,'deepsimbad_traverse','m004_frame_names','2026-11-28 20:54:10.726182+00:00');
INSERT INTO "_sqlite_migrations" VALUES(5,'deepsimbad_traverse','m005_content_digests','2026-11-28 21:10:25.697984+00:00');
INSERT INTO "_sqlite_migrations" VALUES(6,'deepsimbad_traverse','m006_pictures','2026-11-28 21:36:10.540269+00:00');
INSERT INTO "_sqlite_migrations" VALUES(7,'deepsimbad_traverse','m007_cameras','2026-11-28 22:05:33.954929+00:00');
INSERT INTO "_sqlite_migrations" VALUES(8,'deepsimbad_traverse','m008_spool','2026-11-29 01:42:03.557203+00:00');
CREATE TABLE encoding (
            frame_index INTEGER PRIMARY KEY REFERENCES frame (frame_index) ON DELETE CASCADE,
            body BLOB NOT NULL
        );
INSERT INTO "encoding" VALUES(0,X'0000803F00000040');
INSERT INTO "encoding" VALUES(1,X'0000404000008040');
INSERT INTO "encoding" VALUES(3,X'0000A0400000C040');
CREATE TABLE frame (
            frame_index INTEGER PRIMARY KEY CHECK (frame_index >= 0),
            position_m REAL NOT NULL,
            timestamp_us INTEGER,
            x_m REAL,
            y_m REAL
        , name TEXT, content_digest INTEGER, shows_nothing INTEGER, camera TEXT, image_width INTEGER, image_height INTEGER);
INSERT INTO "frame" VALUES(0,0.0,10,0.0,1.0,NULL,NULL,NULL,NULL,NULL,NULL);
INSERT INTO "frame" VALUES(1,1.0,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
INSERT INTO "frame" VALUES(3,3.0,30,2.0,3.0,'000003.png',-7,1,'Cam5',1232,1616);
CREATE TABLE spool (
                frame_index INTEGER PRIMARY KEY REFERENCES frame (frame_index) ON DELETE CASCADE,
                body BLOB NOT NULL
            );
INSERT INTO "spool" VALUES(3,X'89504E47');
CREATE TABLE traverse (
            id INTEGER PRIMARY KEY CHECK (id = 1),
            created_at TEXT NOT NULL,
            encoding_dim INTEGER CHECK (encoding_dim >= 1)
        , weights_sha256 TEXT, black INTEGER, white INTEGER);
INSERT INTO "traverse" VALUES(1,'2026-11-22T02:15:08.990Z',2,'abababababababababababababababababababababababababababababababab',0,4095);
CREATE TABLE view_encoding (
                frame_index INTEGER PRIMARY KEY REFERENCES frame (frame_index) ON DELETE CASCADE,
                body BLOB NOT NULL
            );
INSERT INTO "view_encoding" VALUES(3,X'0000A0400000C040');
CREATE UNIQUE INDEX "idx__sqlite_migrations_migration_set_name"
    ON "_sqlite_migrations" ("migration_set", "name");
COMMIT;
