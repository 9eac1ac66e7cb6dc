// Several files as one zip archive, without compression (PKWARE's APPNOTE, 4.3).

const CRC = Uint32Array.from({ length: 256 }, (_, n) => {
  let c = n;
  for (let k = 0; k < 8; k++) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
  return c;
});

function crc32(bytes: Uint8Array): number {
  let crc = ~0;
  for (const byte of bytes) crc = CRC[(crc ^ byte) & 255]! ^ (crc >>> 8);
  return ~crc >>> 0;
}

/** The fields of a header, little-endian: [value, bytes]. */
function header(fields: [number, number][]): Uint8Array<ArrayBuffer> {
  const bytes = new Uint8Array(fields.reduce((sum, [, size]) => sum + size, 0));
  let at = 0;
  for (const [value, size] of fields) {
    for (let k = 0; k < size; k++) bytes[at++] = Math.floor(value / 256 ** k) & 255;
  }
  return bytes;
}

/** An archive of files, with their paths below the folder that they share. */
export async function archive(files: File[]): Promise<Blob> {
  const parts: BlobPart[] = [];
  const directory: BlobPart[] = [];
  let offset = 0;
  let directoryBytes = 0;
  for (const file of files) {
    const path = file.webkitRelativePath.split("/").slice(1).join("/") || file.name;
    const name = new TextEncoder().encode(path);
    const bytes = new Uint8Array(await file.arrayBuffer());
    // Version 2.0, names in UTF-8, stored, 1980-01-01.
    const shared: [number, number][] = [[20, 2], [0x800, 2], [0, 2], [0, 2], [33, 2], [crc32(bytes), 4], [bytes.length, 4], [bytes.length, 4], [name.length, 2], [0, 2]];
    const local = header([[0x04034b50, 4], ...shared]);
    parts.push(local, name, bytes);
    directory.push(header([[0x02014b50, 4], [20, 2], ...shared, [0, 2], [0, 2], [0, 2], [0, 4], [offset, 4]]), name);
    directoryBytes += 46 + name.length;
    offset += local.length + name.length + bytes.length;
  }
  if (offset + directoryBytes > 0xffffffff || files.length > 0xffff) throw new Error("the folder is too large for the browser: use wildcity push");
  const end = header([[0x06054b50, 4], [0, 2], [0, 2], [files.length, 2], [files.length, 2], [directoryBytes, 4], [offset, 4], [0, 2]]);
  return new Blob([...parts, ...directory, end]);
}
