// The connection to the server: receives moments and states, sends commands, reconnects.

const FIRST_PAUSE_MS = 300;
const LONGEST_PAUSE_MS = 4000;

export class Link {
  // onMoment(scene, pictures), onState(state), onRefused(words), onConnected(isConnected);
  // withoutPictures: pictures are not decoded.
  constructor(handlers) {
    this.handlers = handlers;
    this.pauseMs = FIRST_PAUSE_MS;
    this.waiting = null;
    this.arrived = 0;
    this.drawn = 0;
    this.connect();
  }

  connect() {
    const address = new URL("socket", location.href);
    address.protocol = "ws:";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.pauseMs = FIRST_PAUSE_MS;
      this.handlers.onConnected(true);
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") this.receive(JSON.parse(data));
      else this.take(socket, data);
    };
    socket.onclose = () => {
      this.handlers.onConnected(false);
      setTimeout(() => this.connect(), this.pauseMs);
      this.pauseMs = Math.min(2 * this.pauseMs, LONGEST_PAUSE_MS);
    };
    this.socket = socket;
  }

  send(command) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(command));
  }

  receive(message) {
    if (message.refused) this.handlers.onRefused(message.refused);
    if (message.state) this.handlers.onState(message.state);
  }

  // Decodes pictures asynchronously, then draws scene and pictures together.
  async take(socket, data) {
    const order = ++this.arrived;
    const length = new DataView(data).getUint32(0, true);
    const scene = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    let begin = 4 + length;
    const blobs = scene.pictures.map((size) => {
      const blob = size && !this.handlers.withoutPictures ? new Blob([new Uint8Array(data, begin, size)], { type: "image/jpeg" }) : null;
      begin += size;
      return blob;
    });
    const pictures = await Promise.all(blobs.map((blob) => blob && createImageBitmap(blob)));
    const acknowledge = () => socket === this.socket && this.send({ do: "ack" });
    // Decoding may finish out of order; moments older than the newest are dropped.
    if (Math.max(this.drawn, this.waiting?.order ?? 0) > order) {
      for (const picture of pictures) picture?.close();
      acknowledge();
      return;
    }
    // A waiting moment that is not drawn yet is replaced.
    if (this.waiting) {
      for (const picture of this.waiting.pictures) picture?.close();
      this.waiting.acknowledge();
    } else requestAnimationFrame(() => this.draw());
    this.waiting = { order, scene, pictures, acknowledge };
  }

  draw() {
    const { order, scene, pictures, acknowledge } = this.waiting;
    this.waiting = null;
    this.drawn = order;
    this.handlers.onMoment(scene, pictures);
    for (const picture of pictures) picture?.close();
    acknowledge();
  }
}
