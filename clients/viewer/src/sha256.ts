// SHA-256 (FIPS 180-4) in parts. Browsers have it only for pages over TLS or from this machine, and only for files that fit in
// memory.

/** The first 32 bits of the fractional parts of square or cube roots of the first primes (sections 4.2.2 and 5.3.3). */
function rootsOfPrimes(count: number, root: (prime: number) => number): Uint32Array {
  const primes: number[] = [];
  for (let n = 2; primes.length < count; n++) if (primes.every((prime) => n % prime !== 0)) primes.push(n);
  return Uint32Array.from(primes, (prime) => Math.floor((root(prime) % 1) * 2 ** 32));
}

// Numbers of 32 bits with a sign are the fast ones.
const K = Int32Array.from(rootsOfPrimes(64, Math.cbrt));
const BLOCK_BYTES = 64;

export class Sha256 {
  private readonly state = Int32Array.from(rootsOfPrimes(8, Math.sqrt));
  private readonly words = new Int32Array(64);
  /** The bytes after the last whole block. */
  private readonly rest = new Uint8Array(BLOCK_BYTES);
  private bytes = 0;

  update(data: Uint8Array): void {
    let at = 0;
    const filled = this.bytes % BLOCK_BYTES;
    this.bytes += data.length;
    if (filled > 0) {
      at = Math.min(BLOCK_BYTES - filled, data.length);
      this.rest.set(data.subarray(0, at), filled);
      if (filled + at < BLOCK_BYTES) return;
      this.block(this.rest, 0);
    }
    for (; at + BLOCK_BYTES <= data.length; at += BLOCK_BYTES) this.block(data, at);
    this.rest.set(data.subarray(at));
  }

  /** The digest in hexadecimal digits. Nothing can follow. */
  hex(): string {
    const { bytes } = this;
    // One bit, zeros, and the number of bits in 64 bits: to a whole number of blocks.
    const padding = new Uint8Array(BLOCK_BYTES - ((bytes + 8) % BLOCK_BYTES) + 8);
    padding[0] = 0x80;
    const view = new DataView(padding.buffer);
    view.setUint32(padding.length - 8, Math.floor(bytes / 2 ** 29));
    view.setUint32(padding.length - 4, (bytes * 8) % 2 ** 32);
    this.update(padding);
    return Array.from(this.state, (word) => (word >>> 0).toString(16).padStart(8, "0")).join("");
  }

  private block(data: Uint8Array, from: number): void {
    const { state, words } = this;
    for (let t = 0, at = from; t < 16; t++, at += 4) {
      words[t] = (data[at]! << 24) | (data[at + 1]! << 16) | (data[at + 2]! << 8) | data[at + 3]!;
    }
    for (let t = 16; t < 64; t++) {
      const a = words[t - 15]!;
      const b = words[t - 2]!;
      const s0 = ((a >>> 7) | (a << 25)) ^ ((a >>> 18) | (a << 14)) ^ (a >>> 3);
      const s1 = ((b >>> 17) | (b << 15)) ^ ((b >>> 19) | (b << 13)) ^ (b >>> 10);
      words[t] = (((words[t - 16]! + s0) | 0) + ((words[t - 7]! + s1) | 0)) | 0;
    }
    let [a, b, c, d] = [state[0]!, state[1]!, state[2]!, state[3]!];
    let [e, f, g, h] = [state[4]!, state[5]!, state[6]!, state[7]!];
    for (let t = 0; t < 64; t++) {
      const s1 = ((e >>> 6) | (e << 26)) ^ ((e >>> 11) | (e << 21)) ^ ((e >>> 25) | (e << 7));
      const t1 = (((((h + s1) | 0) + ((e & f) ^ (~e & g))) | 0) + ((K[t]! + words[t]!) | 0)) | 0;
      const s0 = ((a >>> 2) | (a << 30)) ^ ((a >>> 13) | (a << 19)) ^ ((a >>> 22) | (a << 10));
      const t2 = (s0 + ((a & b) ^ (a & c) ^ (b & c))) | 0;
      h = g;
      g = f;
      f = e;
      e = (d + t1) | 0;
      d = c;
      c = b;
      b = a;
      a = (t1 + t2) | 0;
    }
    state[0]! += a;
    state[1]! += b;
    state[2]! += c;
    state[3]! += d;
    state[4]! += e;
    state[5]! += f;
    state[6]! += g;
    state[7]! += h;
  }
}
