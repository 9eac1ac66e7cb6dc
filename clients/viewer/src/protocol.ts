// Observations of wildcity.v1. The types of all messages are in messages.ts.

import type { ImageInfo, Metadata } from "./messages";

export const PROTOCOL = "wildcity.v1";
export const WATCH_PROTOCOL = "wildcity.watch.v1";

/** A message that breaks the protocol. */
export class ProtocolError extends Error {}

/** Bytes of a value of each type of tensor. */
const VALUE_BYTES = { U8: 1, U16: 2, F32: 4 };

/** A tensor of an observation; its bytes are those of the message, not a copy. */
export interface Tensor {
  dtype: keyof typeof VALUE_BYTES;
  shape: number[];
  bytes: Uint8Array<ArrayBuffer>;
}

/** The answer to a step: metadata and tensors. */
export class Observation {
  readonly metadata: Metadata;
  readonly tensors: Map<string, Tensor>;

  constructor(metadata: Metadata, tensors: Map<string, Tensor>) {
    this.metadata = metadata;
    this.tensors = tensors;
  }

  /** The file (jpeg, png) or the pixels (raw) of an image. */
  bytes(image: ImageInfo): Uint8Array<ArrayBuffer> {
    const tensor = this.tensors.get(image.tensor);
    if (!tensor) throw new ProtocolError(`tensor ${image.tensor} is missing`);
    return tensor.bytes;
  }
}

/** Reads a binary message in safetensors layout, and checks all that it says about itself. */
export function parseObservation(message: ArrayBuffer): Observation {
  const fail = (reason: string): never => {
    throw new ProtocolError(`damaged observation: ${reason}`);
  };
  if (message.byteLength < 8) fail("no header length");
  const headerBytes = new DataView(message).getBigUint64(0, true);
  if (headerBytes > BigInt(message.byteLength - 8)) fail("the header is longer than the message");
  const start = 8 + Number(headerBytes);
  const header = json(new Uint8Array(message, 8, Number(headerBytes)), fail);
  const { __metadata__: texts, ...entries } = header as Record<string, any>;
  if (typeof texts?.observation !== "string") fail("no metadata");
  const metadata = json(texts.observation, fail) as Metadata;

  const tensors = new Map<string, Tensor>();
  const ranges: [number, number][] = [];
  for (const [name, entry] of Object.entries(entries)) {
    const { dtype, shape, data_offsets: offsets } = entry ?? {};
    if (!Object.hasOwn(VALUE_BYTES, dtype)) fail(`${name}: dtype ${dtype}`);
    if (!isCounts(shape) || !isCounts(offsets) || offsets.length !== 2) return fail(`${name}: shape or offsets`);
    const [begin, end] = offsets as [number, number];
    const size = shape.reduce((product, side) => product * side, VALUE_BYTES[dtype as Tensor["dtype"]]);
    if (end < begin || end - begin !== size || start + end > message.byteLength) fail(`${name}: offsets`);
    tensors.set(name, { dtype, shape, bytes: new Uint8Array(message, start + begin, size) });
    ranges.push([begin, end]);
  }
  ranges.sort(([a, b], [c, d]) => a - c || b - d);
  let filled = 0;
  for (const [begin, end] of ranges) {
    if (begin !== filled) fail("gap or overlap");
    filled = end;
  }
  if (start + filled !== message.byteLength) fail("bytes after the tensors");

  if (!Array.isArray(metadata?.images) || !metadata.ego?.pose) fail("the metadata has no images or no ego");
  const history = tensors.get("ego.history_xyz");
  if (history?.dtype !== "F32" || history.shape.join() !== "16,3") fail("ego.history_xyz");
  for (const image of [...metadata.images, ...(metadata.history ?? [])]) {
    const tensor = tensors.get(image.tensor);
    if (tensor?.dtype !== "U8") return fail(`${image.tensor} is missing`);
    const raw = `${image.height},${image.width},3`;
    if (image.encoding === "raw" ? tensor.shape.join() !== raw : tensor.shape.length !== 1) fail(image.tensor);
    if (image.encoding === "png" && !isPng(tensor.bytes, image)) fail(`${image.tensor} is no PNG of its size`);
  }
  for (const { lidar, returns } of metadata.sweeps ?? []) {
    const points = tensors.get(`lidar/${lidar}/points`);
    if (points?.dtype !== "F32" || points.shape.join() !== `${returns},3`) fail(`lidar/${lidar}/points`);
  }
  return new Observation(metadata, tensors);
}

function json(source: Uint8Array | string, fail: (reason: string) => never): unknown {
  try {
    const text = typeof source === "string" ? source : new TextDecoder("utf-8", { fatal: true }).decode(source);
    const value: unknown = JSON.parse(text);
    return value !== null && typeof value === "object" && !Array.isArray(value) ? value : fail("no JSON object");
  } catch (error) {
    return error instanceof ProtocolError ? fail("no JSON object") : fail("not JSON in UTF-8");
  }
}

function isCounts(value: unknown): value is number[] {
  return Array.isArray(value) && value.every((count) => Number.isSafeInteger(count) && count >= 0);
}

function isPng(bytes: Uint8Array<ArrayBuffer>, { width, height }: ImageInfo): boolean {
  const signature = [0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a];
  if (bytes.length < 24 || !signature.every((byte, at) => bytes[at] === byte)) return false;
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  return view.getUint32(16) === width && view.getUint32(20) === height;
}
