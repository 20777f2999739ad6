// Connects to the simulated CNC with Basic256Sha256, sign and encrypt, and a user name, tries what a client
// may and may not do, and prints what happened as one line, 'result' and JSON.
//
//   node client.js '{"endpoint": ..., "certificate": ..., "privateKey": ..., "applicationUri": ...,
//                    "pki": ..., "user": ..., "password": ..., "namespace": ...}'
"use strict";
const opcua = require("node-opcua");

const options = JSON.parse(process.argv[2]);

async function connected(password, work) {
  const manager = new opcua.OPCUACertificateManager({
    rootFolder: options.pki,
    automaticallyAcceptUnknownCertificate: true,
  });
  await manager.initialize();
  const client = opcua.OPCUAClient.create({
    applicationName: "toolpoint-node-peer",
    applicationUri: options.applicationUri,
    certificateFile: options.certificate,
    privateKeyFile: options.privateKey,
    clientCertificateManager: manager,
    securityMode: opcua.MessageSecurityMode.SignAndEncrypt,
    securityPolicy: opcua.SecurityPolicy.Basic256Sha256,
    endpointMustExist: false,
    connectionStrategy: { maxRetry: 0 },
  });
  try {
    await client.connect(options.endpoint);
    const session = await client.createSession({
      type: opcua.UserTokenType.UserName,
      userName: options.user,
      password,
    });
    try {
      return await work(session);
    } finally {
      await session.close();
    }
  } finally {
    await client.disconnect();
  }
}

async function exercise(session) {
  const namespaces = await session.readNamespaceArray();
  const index = namespaces.indexOf(options.namespace);
  const id = (name) => `ns=${index};s=${name}`;
  const read = (name) => session.read({ nodeId: id(name), attributeId: opcua.AttributeIds.Value });
  const write = async (name, value) => {
    const status = await session.write({
      nodeId: id(name),
      attributeId: opcua.AttributeIds.Value,
      value: { value: { dataType: opcua.DataType.Double, value } },
    });
    return status.name;
  };
  const vacant = await read("Macro.501");
  return {
    application_uri: (await session.read({ nodeId: "ns=0;i=2254", attributeId: opcua.AttributeIds.Value })).value.value[0],
    program: (await read("Program")).value.value,
    speed: (await read("SpindleSpeed")).value.value,
    vacant: [vacant.statusCode.name, vacant.value.value],
    write: await write("Macro.501", 0.0125),
    read_back: (await read("Macro.501")).value.value,
    write_echo: await write("Macro.510", 1.0),
    write_state: await write("Clock", 1.0),
    write_nan: await write("Macro.502", NaN),
  };
}

(async () => {
  const result = await connected(options.password, exercise);
  result.wrong_password = await connected("wrong", async () => "admitted").catch((error) => error.message);
  console.log(`result ${JSON.stringify(result)}`);
  process.exit(0);
})().catch((error) => {
  console.error(error);
  process.exit(1);
});
