"use strict";
// PostgreSQL with TimescaleDB on a port of 127.0.0.1, one connection at a time. Says "ready", and ends with its input.
const { PGlite } = require("@electric-sql/pglite");
const { timescaledb } = require("@electric-sql/pglite/timescaledb");
const { PGLiteSocketServer } = require("@electric-sql/pglite-socket");

async function main() {
  const db = await PGlite.create({ extensions: { timescaledb } });
  await db.exec("CREATE EXTENSION timescaledb");
  await new PGLiteSocketServer({ db, host: "127.0.0.1", port: Number(process.argv[2]) }).start();
  console.log("ready");
}

process.stdin.on("end", () => process.exit(0)).resume();
main();
