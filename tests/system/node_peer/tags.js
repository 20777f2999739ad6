// Connects to the daemon's OPC UA server with Basic256Sha256 and a user name, looks for the server first as clients do that
// know only its address, browses, reads, subscribes, calls, tries to write, and prints what happened as one line.
//
//   node tags.js '{"endpoint": ..., "certificate": ..., "privateKey": ..., "applicationUri": ..., "pki": ..., "user": ...,
//                  "password": ..., "namespace": ..., "mode": "Sign" or "SignAndEncrypt"}'
"use strict";
const opcua = require("node-opcua");

const options = JSON.parse(process.argv[2]);

async function main() {
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
    securityMode: opcua.MessageSecurityMode[options.mode],
    securityPolicy: opcua.SecurityPolicy.Basic256Sha256,
    connectionStrategy: { maxRetry: 0 },
  });
  await client.connect(options.endpoint);
  const anonymous = await client.createSession().catch((error) => error.message);
  const session = await client.createSession({
    type: opcua.UserTokenType.UserName,
    userName: options.user,
    password: options.password,
  });
  const index = (await session.readNamespaceArray()).indexOf(options.namespace);
  const id = (name) => `ns=${index};s=${name}`;
  const folder = await session.browse(id("temperatures"));
  const names = folder.references.filter((each) => each.isForward && each.nodeClass === opcua.NodeClass.Variable);
  const tag = await session.read({ nodeId: id("temperature.1"), attributeId: opcua.AttributeIds.Value });
  const held = await session.read({ nodeId: id("temperature.2"), attributeId: opcua.AttributeIds.Value });
  const unit = await session.read({ nodeId: id("temperature.1.EngineeringUnits"), attributeId: opcua.AttributeIds.Value });
  const subscription = await session.createSubscription2({
    requestedPublishingInterval: 250,
    requestedMaxKeepAliveCount: 10,
    requestedLifetimeCount: 100,
    maxNotificationsPerPublish: 100,
    publishingEnabled: true,
    priority: 1,
  });
  const item = await subscription.monitor(
    { nodeId: id("temperature.1"), attributeId: opcua.AttributeIds.Value },
    { samplingInterval: 250, queueSize: 1, discardOldest: true },
    opcua.TimestampsToReturn.Both,
  );
  const told = new Promise((resolve) => {
    item.on("changed", (value) => {
      if (value.value.value === 23.25) resolve(value.value.value);
      else console.log("subscribed");
    });
  });
  const heard = await told;
  await subscription.terminate();
  const write = await session.write({
    nodeId: id("temperature.1"),
    attributeId: opcua.AttributeIds.Value,
    value: { value: { dataType: opcua.DataType.Double, value: 1.0 } },
  });
  const called = await session.call({
    objectId: id("machine"),
    methodId: id("disable"),
    inputArguments: [
      { dataType: opcua.DataType.String, arrayType: opcua.VariantArrayType.Array, value: [] },
      { dataType: opcua.DataType.Boolean, value: false },
    ],
  });
  const method = await session.getArgumentDefinition(id("disable"));
  await session.close();
  await client.disconnect();
  const result = {
    anonymous,
    names: names.map((each) => each.browseName.name),
    tag: [tag.value.value, tag.statusCode.name, tag.sourceTimestamp.getTime()],
    held: [held.value.value, held.statusCode.name],
    unit: unit.value.value.displayName.text,
    heard,
    write: write.name,
    called: [called.statusCode.name, called.outputArguments.map((each) => each.value)],
    arguments: method.inputArguments.map((each) => each.name),
  };
  console.log(`result ${JSON.stringify(result)}`);
  process.exit(0);
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
