BEGIN TRANSACTION;
CREATE TABLE "_sqlite_migrations" (
   "id" INTEGER PRIMARY KEY,
   "migration_set" TEXT,
   "name" TEXT,
   "applied_at" TEXT
);
INSERT INTO "_sqlite_migrations" VALUES(1,'deepsimbad_thumbnail','m001_thumbnails','2026-11-29 01:00:00.000000+00:00');
CREATE TABLE thumbnail (frame_digest INTEGER PRIMARY KEY, body BLOB NOT NULL);
INSERT INTO "thumbnail" VALUES(-7046029254386353131,X'FFD8FFD9');
CREATE UNIQUE INDEX "idx__sqlite_migrations_migration_set_name"
    ON "_sqlite_migrations" ("migration_set", "name");
COMMIT;
