// A host application of Sparkplug B 3.0 on Eclipse Tahu's codec and MQTT.js. It tells its state, follows births, deaths and the
// numbers of messages, asks for a rebirth where they have a gap or a metric was not born, and prints what it takes, as JSON
// lines. Lines on standard input: online, offline, rebirth, garbage, quit.
const mqtt = require('mqtt')
const sparkplug = require('sparkplug-payload').get('spBv1.0')
const readline = require('readline')

const options = JSON.parse(process.argv[2])
const stateTopic = `spBv1.0/STATE/${options.host}`
let born = null // bdSeq, next number, names of metrics by device
let lastMs = 0

const print = (content) => console.log(JSON.stringify(content, (_, v) => (typeof v === 'bigint' ? Number(v) : v)))
const plain = (v) => (v !== null && typeof v === 'object' && 'toNumber' in v ? v.toNumber() : v === undefined ? null : v)
const now = () => (lastMs = Math.max(Date.now(), lastMs + 1))
const state = (online, timestamp) => JSON.stringify({ online, timestamp })

const beganMs = now()
const client = mqtt.connect(`mqtt://127.0.0.1:${options.port}`, {
  clientId: options.host, clean: true, reconnectPeriod: 100,
  will: { topic: stateTopic, payload: state(false, beganMs), qos: 1, retain: true }
})
const tell = (online) => client.publish(stateTopic, state(online, now()), { qos: 1, retain: true })
const ask = (group, node) => client.publish(
  `spBv1.0/${group}/NCMD/${node}`,
  sparkplug.encodePayload({ timestamp: now(), metrics: [{ name: 'Node Control/Rebirth', type: 'Boolean', value: true }] }))

client.on('connect', () => {
  born = null
  client.subscribe(['spBv1.0/+/+/+/#', stateTopic], { qos: 1 }, () => {
    if (options.online) tell(true)
    print({ subscribed: true })
  })
})

client.on('message', (topic, content, packet) => {
  const [, group, kind, node, device] = topic.split('/')
  if (group === 'STATE' || kind === 'NCMD' || kind === 'DCMD') return
  const payload = sparkplug.decodePayload(content)
  const metrics = payload.metrics.map((m) => ({
    name: m.name, type: m.type, value: plain(m.value), utc_ms: plain(m.timestamp), historical: m.isHistorical === true,
    unit: m.properties && m.properties.engUnit ? m.properties.engUnit.value : '',
    quality: m.properties && m.properties.Quality ? m.properties.Quality.value : 192
  }))
  const seq = plain(payload.seq)
  let wrong = ''
  if (kind === 'NBIRTH') {
    born = { bdSeq: metrics.find((m) => m.name === 'bdSeq').value, next: 1, names: {} }
    if (seq !== 0) wrong = `NBIRTH numbered ${seq}`
  } else if (kind === 'NDEATH') {
    const bdSeq = metrics.find((m) => m.name === 'bdSeq').value
    if (born !== null && bdSeq !== born.bdSeq) wrong = `death of ${bdSeq} while ${born.bdSeq} lives`
    if (payload.seq !== undefined && payload.seq !== null && seq !== 0) wrong = `NDEATH numbered ${seq}`
    born = null
  } else if (born === null) {
    wrong = `${kind} before a birth`
  } else {
    if (seq !== born.next) wrong = `${seq} instead of ${born.next}`
    born.next = (seq + 1) % 256
    if (kind === 'DBIRTH') born.names[device] = new Set(metrics.map((m) => m.name))
    else if (kind === 'DDEATH') delete born.names[device]
    else if (!born.names[device]) wrong = 'data of a device that was not born'
    else for (const m of metrics) if (!born.names[device].has(m.name)) wrong = `metric ${m.name} was not born`
  }
  if (packet.retain || (kind !== 'NDEATH' && packet.qos !== 0)) wrong = `${kind} retained or with quality of service`
  print({ group, kind, node, device: device || null, seq, metrics, wrong })
  if (wrong && options.rebirths) ask(group, node)
})

readline.createInterface({ input: process.stdin }).on('line', (line) => {
  if (line === 'online') tell(true)
  else if (line === 'offline') tell(false)
  else if (line === 'rebirth') ask(options.group, options.node)
  else if (line === 'garbage') client.publish(`spBv1.0/${options.group}/NCMD/${options.node}`, Buffer.from([255, 1, 2, 3]))
  else if (line === 'quit') client.end(false, {}, () => process.exit(0))
})
