// The one connection: moments and states in, commands out; it comes back by itself.

const FIRST_PAUSE_MS = 300;
const LONGEST_PAUSE_MS = 4000;

export class Link {
  // onMoment(scene, pictures), onState(state), onRefused(words), onConnected(isConnected);
  // withoutPictures leaves these undecoded.
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
      if (typeof data === "string") this.hear(JSON.parse(data));
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

  hear(message) {
    if (message.refused) this.handlers.onRefused(message.refused);
    if (message.state) this.handlers.onState(message.state);
  }

  // Pictures are decoded beside the page's thread; then scene and pictures are drawn in one go.
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
    // Pictures may be decoded in another order than they came in: what is older is past.
    if (Math.max(this.drawn, this.waiting?.order ?? 0) > order) {
      for (const picture of pictures) picture?.close();
      acknowledge();
      return;
    }
    // The one before it, if it was not drawn yet, never will be.
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
