// An independent OPC UA client (node-opcua), driven by the tests: a request a line in, an answer a line out.
"use strict";
const readline = require("node:readline");
const opcua = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");

const EVENT_FIELDS = [
  "EventId", "EventType", "SourceName", "Time", "Message", "Severity", "Retain", "ConditionName", "ActiveState.Id",
  "AckedState.Id", "ShelvingState.CurrentState", "OutOfServiceState.Id",
  "SuppressedOrShelved", "Comment", "ClientUserId", "2:Cause", "2:Evidence",
];
let client, session, subscription, alarms;
const values = {}, events = [];

function plain(variant) {
  const value = variant?.value;
  if (value === null || value === undefined) return null;
  if (Buffer.isBuffer(value)) return value.toString("hex");
  if (value instanceof Date) return value.toISOString();
  if (value instanceof opcua.NodeId) return value.toString();
  if (typeof value === "object" && "text" in value) return value.text;
  if (typeof value === "object" && typeof value.toJSON === "function") return value.toJSON();
  return value;
}
const shown = (data) => ({
  value: plain(data.value), status: data.statusCode.name,
  t_ms: data.sourceTimestamp ? data.sourceTimestamp.getTime() : null,
});

const commands = {
  async connect({ url, user, password, encrypted, folder }) {
    const manager = new OPCUACertificateManager({ rootFolder: folder, automaticallyAcceptUnknownCertificate: true });
    await manager.initialize();
    client = opcua.OPCUAClient.create({
      applicationName: "fantwin test", endpointMustExist: false, clientCertificateManager: manager,
      connectionStrategy: { maxRetry: 0 }, requestedSessionTimeout: 60000,
      securityMode: encrypted ? opcua.MessageSecurityMode.SignAndEncrypt : opcua.MessageSecurityMode.None,
      securityPolicy: encrypted ? opcua.SecurityPolicy.Basic256Sha256 : opcua.SecurityPolicy.None,
    });
    await client.connect(url);
    session = await client.createSession(
      user ? { type: opcua.UserTokenType.UserName, userName: user, password } : { type: opcua.UserTokenType.Anonymous });
    return { policy: client.securityPolicy, mode: opcua.MessageSecurityMode[client.securityMode] };
  },
  async browse({ node }) {
    const found = await session.browse({ nodeId: node, referenceTypeId: "HierarchicalReferences", resultMask: 63,
      includeSubtypes: true, browseDirection: opcua.BrowseDirection.Forward });
    return found.references.map((each) => ({
      id: each.nodeId.toString(), name: each.browseName.name, class: opcua.NodeClass[each.nodeClass],
      type: each.typeDefinition.toString(), by: each.referenceTypeId.toString() }));
  },
  async path({ start, path }) {
    const found = await session.translateBrowsePath(opcua.makeBrowsePath(start, path));
    return found.targets.map((each) => each.targetId.toString());
  },
  async read({ nodes }) {
    const found = await session.read(nodes.map((nodeId) => ({ nodeId, attributeId: opcua.AttributeIds.Value })));
    return found.map(shown);
  },
  async write({ node }) {
    return (await session.write({ nodeId: node, attributeId: opcua.AttributeIds.Value,
      value: { value: { dataType: "Double", value: 1 } } })).name;
  },
  async watch({ nodes, notifier }) {
    subscription ??= await session.createSubscription2({ requestedPublishingInterval: 100, publishingEnabled: true,
      requestedLifetimeCount: 1000, requestedMaxKeepAliveCount: 20, maxNotificationsPerPublish: 1000, priority: 1 });
    for (const nodeId of nodes ?? []) {
      const item = await subscription.monitor({ nodeId, attributeId: opcua.AttributeIds.Value },
        { samplingInterval: 0, queueSize: 5, discardOldest: true }, opcua.TimestampsToReturn.Both);
      item.on("changed", (data) => (values[nodeId] ??= []).push(shown(data)));
    }
    if (notifier) {
      const filter = opcua.constructEventFilter([...EVENT_FIELDS, "ConditionId"], opcua.ofType("ConditionType"));
      const item = await subscription.monitor({ nodeId: notifier, attributeId: opcua.AttributeIds.EventNotifier },
        { samplingInterval: 0, queueSize: 1000, discardOldest: true, filter }, opcua.TimestampsToReturn.Both);
      item.on("changed", (fields) => events.push(
        Object.fromEntries([...EVENT_FIELDS, "ConditionId"].map((name, at) => [name, plain(fields[at])]))));
    }
    return subscription.subscriptionId;
  },
  values: async () => values,
  events: async () => events.splice(0),
  async call({ object, method, inputs }) {
    const types = { number: "Double", string: "LocalizedText" };
    const inputArguments = (inputs ?? []).map((value) => value?.hex !== undefined
      ? { dataType: "ByteString", value: Buffer.from(value.hex, "hex") }
      : value?.uint32 !== undefined ? { dataType: "UInt32", value: value.uint32 }
      : { dataType: types[typeof value], value: typeof value === "string" ? opcua.coerceLocalizedText(value) : value });
    const found = await session.call({ objectId: object, methodId: method, inputArguments });
    return found.statusCode.name;
  },
  acknowledge: async ({ condition, event, comment }) =>
    (await session.acknowledgeCondition(opcua.resolveNodeId(condition), Buffer.from(event, "hex"), comment)).name,
  confirm: async ({ condition, event, comment }) =>
    (await session.confirmCondition(opcua.resolveNodeId(condition), Buffer.from(event, "hex"), comment)).name,
  comment: async ({ condition, event, comment }) =>
    (await session.addCommentCondition(opcua.resolveNodeId(condition), Buffer.from(event, "hex"), comment)).name,
  // node-opcua's own display of alarms: it subscribes with a filter by type, and refreshes
  async alarms() {
    alarms ??= await opcua.installAlarmMonitoring(session);
    return alarms.alarms().map((each) => ({ condition: each.conditionId.toString(), retain: each.getRetain() }));
  },
  async history({ node, start, end }) {
    const found = await session.performMessageTransaction(new opcua.HistoryReadRequest({
      historyReadDetails: new opcua.ReadEventDetails({ startTime: new Date(start), endTime: new Date(end),
        numValuesPerNode: 0, filter: opcua.constructEventFilter(["EventId", "Message", "SourceName"]) }),
      timestampsToReturn: opcua.TimestampsToReturn.Both, releaseContinuationPoints: false,
      nodesToRead: [{ nodeId: opcua.resolveNodeId(node) }] }));
    return (found.results[0].historyData?.events ?? []).map((each) => each.eventFields.map(plain));
  },
  async close() {
    await session?.close(true);
    await client?.disconnect();
    return true;
  },
};

(async () => {
  for await (const line of readline.createInterface({ input: process.stdin })) {
    const { command, ...rest } = JSON.parse(line);
    let answer;
    try {
      answer = { result: await commands[command](rest) };
    } catch (error) {
      answer = { error: String(error.message ?? error) };
    }
    process.stdout.write(`ANSWER ${JSON.stringify(answer)}\n`);
    if (command === "close") process.exit(0);
  }
})();
