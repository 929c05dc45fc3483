// SPDX-License-Identifier: Apache-2.0
// A crowd of viewers, each with a connection of its own and Foxglove's own client on it.
//
//   node crowd.mjs URL COUNT TOPIC BIG
//
// All look at TOPIC. The first of them looks at BIG as well and reads nothing from then on. Says
// 'ready' once all look, and at its input's end how many messages each has got.
import protocol from '@foxglove/ws-protocol';
import WebSocket from 'ws';

const { FoxgloveClient } = protocol;
const [url, count, topic, big] = process.argv.slice(2);
const got = new Array(Number(count)).fill(0);
let looking = 0;

for (let number = 0; number < got.length; number++) {
  const socket = new WebSocket(
    url, [FoxgloveClient.SUPPORTED_SUBPROTOCOL, 'foxglove.sdk.v1'], { rejectUnauthorized: false });
  const client = new FoxgloveClient({ ws: socket });
  const wanted = new Set(number === 0 ? [topic, big] : [topic]);
  client.on('error', (error) => { console.error(String(error?.message ?? error)); process.exit(1); });
  client.on('close', () => { console.error(`viewer ${number} was sent away`); process.exit(1); });
  client.on('message', () => { got[number] += 1; });
  client.on('advertise', (channels) => {
    for (const channel of channels) {
      if (wanted.delete(channel.topic)) client.subscribe(channel.id);
    }
    if (wanted.size === 0 && !wanted.done) {
      wanted.done = true;
      // what was asked for leaves first
      if (number === 0) setTimeout(() => socket._socket.pause(), 200);
      if (++looking === got.length) console.log('ready');
    }
  });
}
process.stdin.on('end', () => { console.log(JSON.stringify(got)); process.exit(0); }).resume();
