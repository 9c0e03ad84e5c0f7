BEGIN TRANSACTION;
CREATE TABLE "_sqlite_migrations" (
   "id" INTEGER PRIMARY KEY,
   "migration_set" TEXT,
   "name" TEXT,
   "applied_at" TEXT
);
INSERT INTO "_sqlite_migrations" VALUES(1,'deepsimbad_map','m001_postings_and_arrays','2026-11-22 03:23:58.539135+00:00');
INSERT INTO "_sqlite_migrations" VALUES(2,'deepsimbad_map','m002_packed_experience','2026-11-22 03:23:58.540331+00:00');
INSERT INTO "_sqlite_migrations" VALUES(3,'deepsimbad_map','m003_calibration','2026-11-22 03:23:58.540522+00:00');
INSERT INTO "_sqlite_migrations" VALUES(4,'deepsimbad_map','m004_coded_lists','2026-11-28 20:54:22.021378+00:00');
INSERT INTO "_sqlite_migrations" VALUES(5,'deepsimbad_map','m005_without_checksum','2026-11-30 17:26:31.901103+00:00');
CREATE TABLE calibration (
            name TEXT NOT NULL,
            part INTEGER NOT NULL,
            dtype TEXT NOT NULL,
            shape TEXT NOT NULL,
            body BLOB NOT NULL,
            PRIMARY KEY (name, part)
        );
INSERT INTO "calibration" VALUES('correlation',0,'<f8','[3]',X'000000000000D03F000000000000E03F000000000000E83F');
INSERT INTO "calibration" VALUES('listed_score',0,'<f8','[2,3]',X'00000000000000C0000000000000F8BF000000000000F0BF000000000000F0BF000000000000E0BF000000000000D0BF');
INSERT INTO "calibration" VALUES('off_route_model',0,'<f8','[2]',X'000000000000F8BF000000000000E03F');
INSERT INTO "calibration" VALUES('telling_bits',0,'<f4','[4]',X'0000804000004040000000400000803F');
CREATE TABLE landmark_model (
                name TEXT NOT NULL,
                part INTEGER NOT NULL,
                dtype TEXT NOT NULL,
                shape TEXT NOT NULL,
                body BLOB NOT NULL,
                PRIMARY KEY (name, part)
            );
INSERT INTO "landmark_model" VALUES('prototypes',0,'<f4','[3,2]',X'000000000000803F0000004000004040000080400000A040');
CREATE TABLE landmark_statistics (
                name TEXT NOT NULL,
                part INTEGER NOT NULL,
                dtype TEXT NOT NULL,
                shape TEXT NOT NULL,
                body BLOB NOT NULL,
                PRIMARY KEY (name, part)
            );
INSERT INTO "landmark_statistics" VALUES('statistics',0,'<f8','[2,3]',X'0000000000000000000000000000F03F0000000000000040000000000000084000000000000010400000000000001440');
CREATE TABLE listed_dissimilarity (
                name TEXT NOT NULL,
                part INTEGER NOT NULL,
                dtype TEXT NOT NULL,
                shape TEXT NOT NULL,
                body BLOB NOT NULL,
                PRIMARY KEY (name, part)
            );
INSERT INTO "listed_dissimilarity" VALUES('values',0,'<f4','[2,4]',X'000000000000803F0000004000004040000080400000A0400000C0400000E040');
CREATE TABLE map (
            id INTEGER PRIMARY KEY CHECK (id = 1),
            domain TEXT NOT NULL,
            version INTEGER NOT NULL,
            created_at TEXT NOT NULL,
            config TEXT NOT NULL,
            evaluator TEXT NOT NULL,
            closed INTEGER NOT NULL CHECK (closed IN (0, 1)),
            actions_m TEXT NOT NULL,
            metrics TEXT NOT NULL,
            n_map_images INTEGER NOT NULL,
            n_landmarks INTEGER NOT NULL,
            list_length INTEGER NOT NULL);
INSERT INTO "map" VALUES(1,'campus',1,'2025-01-01T00:00:00.000Z','{"list_length":2,"n_landmarks":3}','{"kind":"feature_l2"}',1,'[1.0,2.0,3.0]','{"anr":4.5}',4,3,2);
CREATE TABLE map_image_encoding (
                name TEXT NOT NULL,
                part INTEGER NOT NULL,
                dtype TEXT NOT NULL,
                shape TEXT NOT NULL,
                body BLOB NOT NULL,
                PRIMARY KEY (name, part)
            );
CREATE TABLE "posting" (
            part INTEGER PRIMARY KEY,
            landmark INTEGER,
            rank INTEGER,
            body BLOB NOT NULL
        );
INSERT INTO "posting" VALUES(1,NULL,NULL,X'1920');
CREATE TABLE "q_value" (
            part INTEGER PRIMARY KEY,
            name TEXT NOT NULL,
            dtype TEXT NOT NULL,
            shape TEXT NOT NULL,
            lowest REAL,
            step REAL,
            body BLOB NOT NULL
        );
INSERT INTO "q_value" VALUES(0,'q_values','<u2','[4,3]',0.0,4.19623102159151582096e-03,X'789C6310D7738D2DE95EB4EBE28BFF0C6EDD17C56317BDD02BD9F91F0081950BF5');
CREATE TABLE route (
                name TEXT NOT NULL,
                part INTEGER NOT NULL,
                dtype TEXT NOT NULL,
                shape TEXT NOT NULL,
                body BLOB NOT NULL,
                PRIMARY KEY (name, part)
            );
INSERT INTO "route" VALUES('position_m',0,'<f8','[4]',X'0000000000000000000000000000F83F00000000000008400000000000001240');
INSERT INTO "route" VALUES('timestamp_us',0,'<i8','[4]',X'0000000000000000E803000000000000D007000000000000B80B000000000000');
INSERT INTO "route" VALUES('x_m',0,'<f8','[4]',X'0000000000000000000000000000F03F00000000000000400000000000000840');
INSERT INTO "route" VALUES('y_m',0,'<f8','[4]',X'0000000000000080000000000000F0BF00000000000000C000000000000008C0');
CREATE UNIQUE INDEX "idx__sqlite_migrations_migration_set_name"
    ON "_sqlite_migrations" ("migration_set", "name");
COMMIT;
