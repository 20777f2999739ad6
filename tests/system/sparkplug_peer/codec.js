// Eclipse Tahu's codec as a filter: a payload in base64 per line in, what it holds as JSON per line out.
const sparkplug = require('sparkplug-payload').get('spBv1.0')
const readline = require('readline')
const plain = (v) => (v !== null && typeof v === 'object' && 'toString' in v ? v.toString() : v === undefined ? null : v)

readline.createInterface({ input: process.stdin }).on('line', (line) => {
  const payload = sparkplug.decodePayload(Buffer.from(line, 'base64'))
  console.log(JSON.stringify({
    timestamp: plain(payload.timestamp), seq: plain(payload.seq),
    metrics: payload.metrics.map((m) => ({
      name: m.name, type: m.type, value: plain(m.value), timestamp: plain(m.timestamp),
      historical: m.isHistorical === true,
      properties: Object.fromEntries(Object.entries(m.properties || {}).map(([k, v]) => [k, v.value]))
    }))
  }))
})
