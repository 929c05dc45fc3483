// SPDX-License-Identifier: Apache-2.0
// A viewer: Foxglove's own client, driven by lines of JSON on its input, which tells what it sees
// in lines of JSON on its output.
//
//   node viewer.mjs URL
//
// Takes {subscribe: TOPIC}, {unsubscribe: TOPIC}, {publish: TOPIC, schemaName, definition, message},
// {call: SERVICE, request} or with {payload: BASE64}, {get: PARAMETERS}, {set: [{name, value}]},
// {follow: PARAMETERS} and {fetch: URI}. Tells {open}, {channel}, {gone}, {message}, {service},
// {withdrawn}, {called, response}, {parameters}, {asset}, {capabilities}, {status} and {error}.
import protocol from '@foxglove/ws-protocol';
import rosmsg from '@foxglove/rosmsg';
import serialization from '@foxglove/rosmsg2-serialization';
import readline from 'node:readline';
import WebSocket from 'ws';

const { FoxgloveClient } = protocol;
const tell = (what) => process.stdout.write(
  JSON.stringify(what, (_, value) => typeof value === 'bigint' ? Number(value)
    : ArrayBuffer.isView(value) ? Array.from(value) : value) + '\n');

const socket = new WebSocket(
  process.argv[2], [FoxgloveClient.SUPPORTED_SUBPROTOCOL, 'foxglove.sdk.v1'],
  { rejectUnauthorized: false });
socket.on('unexpected-response', (_, response) => tell({ error: `status ${response.statusCode}` }));
const client = new FoxgloveClient({ ws: socket });
const channels = new Map(), subscriptions = new Map(), advertised = new Map();
const services = new Map(), calls = new Map(), assets = new Map();
const parsed = ({ schema }) => rosmsg.parse(schema, { ros2: true });

client.on('open', () => tell({ open: true }));
client.on('error', (error) => tell({ error: String(error?.message ?? error) }));
client.on('close', () => { tell({ closed: true }); process.exit(0); });
client.on('status', ({ message }) => {
  // The SDK announces a channel before it takes subscriptions to it: a fast viewer is refused.
  const refused = [...channels.values()].find(({ id }) => message === `Unknown channel ID: ${id}`);
  if (refused === undefined) { tell({ status: message }); return; }
  for (const [id, subscription] of subscriptions) {
    if (subscription.topic === refused.topic) {
      client.unsubscribe(id);
      subscriptions.delete(id);
      subscriptions.set(client.subscribe(refused.id), subscription);
      break;
    }
  }
});
client.on('advertise', (list) => {
  for (const channel of list) {
    channels.set(channel.topic, channel);
    tell({ channel: channel.topic, encoding: channel.encoding, schema: channel.schemaName });
  }
});
client.on('unadvertise', (ids) => {
  for (const [topic, channel] of channels) {
    if (ids.includes(channel.id)) { channels.delete(topic); tell({ gone: topic }); }
  }
});
client.on('message', ({ subscriptionId, data }) => {
  const { topic, reader } = subscriptions.get(subscriptionId);
  tell({ topic, size: data.byteLength, at: Date.now(),
    message: reader ? reader.readMessage(data) : Buffer.from(
      data.buffer, data.byteOffset, data.byteLength).toString('base64') });
});

client.on('serverInfo', ({ capabilities }) => tell({ capabilities }));
client.on('advertiseServices', (list) => {
  for (const service of list) {
    services.set(service.name, service);
    tell({ service: service.name, type: service.type, request: service.request.schema });
  }
});
client.on('unadvertiseServices', (ids) => {
  for (const [name, { id }] of services) {
    if (ids.includes(id)) { services.delete(name); tell({ withdrawn: name }); }
  }
});
client.on('serviceCallResponse', ({ callId, data }) => {
  const name = calls.get(callId);
  tell({ called: name, response: new serialization.MessageReader(
    parsed(services.get(name).response)).readMessage(data) });
});
client.on('serviceCallFailure', ({ callId, message }) =>
  tell({ called: calls.get(callId), failure: message }));
client.on('parameterValues', ({ parameters, id }) => tell({ parameters, id }));
client.on('fetchAssetResponse', ({ requestId, status, error, data }) => tell({
  asset: assets.get(requestId), status, error,
  data: data && Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString('base64') }));

readline.createInterface({ input: process.stdin }).on('line', (line) => {
  const wish = JSON.parse(line);
  if (wish.subscribe) {
    const channel = channels.get(wish.subscribe);
    const reader = channel.encoding === 'cdr'
      ? new serialization.MessageReader(rosmsg.parse(channel.schema, { ros2: true })) : undefined;
    subscriptions.set(client.subscribe(channel.id), { topic: wish.subscribe, reader });
  } else if (wish.unsubscribe) {
    for (const [id, { topic }] of subscriptions) {
      if (topic === wish.unsubscribe) { client.unsubscribe(id); subscriptions.delete(id); }
    }
  } else if (wish.publish) {
    if (!advertised.has(wish.publish)) {
      advertised.set(wish.publish, client.advertise({
        topic: wish.publish, encoding: wish.encoding ?? 'cdr', schemaName: wish.schemaName }));
    }
    const writer = new serialization.MessageWriter(rosmsg.parse(wish.definition, { ros2: true }));
    client.sendMessage(advertised.get(wish.publish), writer.writeMessage(wish.message));
  } else if (wish.call) {
    const { id, request } = services.get(wish.call);
    const data = wish.payload !== undefined ? Buffer.from(wish.payload, 'base64')
      : new serialization.MessageWriter(parsed(request)).writeMessage(wish.request);
    calls.set(calls.size + 1, wish.call);
    client.sendServiceCallRequest({ serviceId: id, callId: calls.size, encoding: 'cdr',
      data: new DataView(data.buffer, data.byteOffset, data.byteLength) });
  } else if (wish.get) {
    client.getParameters(wish.get, 'get');
  } else if (wish.set) {
    client.setParameters(wish.set, 'set');
  } else if (wish.follow) {
    client.subscribeParameterUpdates(wish.follow);
  } else if (wish.fetch) {
    assets.set(assets.size + 1, wish.fetch);
    client.fetchAsset(wish.fetch, assets.size);
  }
}).on('close', () => process.exit(0));
