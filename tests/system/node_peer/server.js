// Serves a CNC with Basic256Sha256, sign and encrypt, and a user name. Prints its endpoint as one line, then every
// macro write as one line, 'written' and JSON; ends when its standard input ends.
//
// The library itself prints warnings among these lines.
//
//   node server.js '{"port": ..., "certificate": ..., "privateKey": ..., "applicationUri": ..., "pki": ...,
//                    "trusted": ..., "user": ..., "password": ..., "namespace": ..., "macros": [...], "echo": [...],
//                    "macroTypes": {"501": "Float"}, "state": {"Program": ["String", "O1000"]},
//                    "takes": nodes in one request, 0 without a limit, "sessions": so many at a time}'
"use strict";
const fs = require("fs");
const opcua = require("node-opcua");

const options = JSON.parse(process.argv[2]);
const SAMPLING_MS = 50; // without a smallest sampling interval node-opcua polls getters as fast as a client asks
const STATE = {
  Mode: 1, RunState: 3, Alarm: 0, Program: 1000, SequenceNumber: 20, PowerOnCount: 7, WorkOffset: 54, ToolNumber: 3,
};
const MEASURED = { SpindleSpeed: () => 5000, SpindleMotorTemperature: () => 31.5, Clock: () => process.uptime() };

function addVariables(addressSpace) {
  const namespace = addressSpace.registerNamespace(options.namespace);
  const folder = namespace.addObject({ organizedBy: addressSpace.rootFolder.objects, browseName: "CNC" });
  const add = (name, dataType, value, access) =>
    namespace.addVariable({
      componentOf: folder,
      browseName: name,
      nodeId: `s=${name}`,
      dataType,
      minimumSamplingInterval: SAMPLING_MS,
      accessLevel: access,
      userAccessLevel: access,
      value,
    });
  for (const [name, number] of Object.entries(STATE)) {
    const [type, value] = options.state[name] || ["Int32", number];
    const get = () => new opcua.Variant({ dataType: opcua.DataType[type], arrayType: opcua.VariantArrayType.Scalar, value });
    add(name, opcua.DataType[type], { get }, "CurrentRead");
  }
  for (const [name, read] of Object.entries(MEASURED)) {
    const get = () => new opcua.Variant({ dataType: opcua.DataType.Double, value: read() });
    add(name, opcua.DataType.Double, { get }, "CurrentRead");
  }
  const degc = { dataType: opcua.DataType.Float, arrayType: opcua.VariantArrayType.Array, value: [21.5, 22.5] };
  namespace.addVariable({
    componentOf: folder, browseName: "Temperatures", nodeId: "s=Temperatures", dataType: degc.dataType, valueRank: 1,
    minimumSamplingInterval: SAMPLING_MS, value: { get: () => new opcua.Variant(degc) },
  });
  const values = new Map();
  for (const number of [...options.macros, ...options.echo]) {
    const dataType = opcua.DataType[options.macroTypes[number] || "Double"];
    const get = () =>
      values.has(number)
        ? new opcua.Variant({ dataType, arrayType: opcua.VariantArrayType.Scalar, value: values.get(number) })
        : opcua.StatusCodes.BadNoData;
    const set = (variant) => {
      values.set(number, variant.value);
      console.log(`written ${JSON.stringify([number, variant.value])}`);
      return opcua.StatusCodes.Good;
    };
    const writable = options.macros.includes(number);
    add(`Macro.${number}`, dataType, writable ? { get, set } : { get },
        writable ? "CurrentRead | CurrentWrite" : "CurrentRead");
  }
}

(async () => {
  const manager = new opcua.OPCUACertificateManager({
    rootFolder: options.pki,
    automaticallyAcceptUnknownCertificate: false,
  });
  await manager.initialize();
  await manager.trustCertificate(fs.readFileSync(options.trusted));
  const server = new opcua.OPCUAServer({
    port: options.port,
    host: "127.0.0.1",
    hostname: "127.0.0.1",
    resourcePath: "/cnc",
    certificateFile: options.certificate,
    privateKeyFile: options.privateKey,
    serverCertificateManager: manager,
    serverInfo: { applicationUri: options.applicationUri },
    securityModes: [opcua.MessageSecurityMode.SignAndEncrypt],
    securityPolicies: [opcua.SecurityPolicy.Basic256Sha256],
    allowAnonymous: false,
    serverCapabilities: new opcua.ServerCapabilities({
      maxSessions: options.sessions || 10,
      operationLimits: { maxNodesPerRead: options.takes, maxNodesPerWrite: options.takes },
    }),
    userManager: { isValidUser: (user, password) => user === options.user && password === options.password },
  });
  await server.initialize();
  addVariables(server.engine.addressSpace);
  await server.start();
  console.log(`opc.tcp://127.0.0.1:${options.port}/cnc`);
  process.stdin.resume();
  process.stdin.on("end", async () => {
    await server.shutdown(0);
    process.exit(0);
  });
})().catch((error) => {
  console.error(error);
  process.exit(1);
});
