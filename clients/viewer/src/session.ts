// Names of the sessions that only look. Their records are no drives, and the first page leaves them out.

const PREFIX = "viewer-";

export function viewerSession(kind: string): string {
  const random = crypto.getRandomValues(new Uint32Array(2));
  return `${PREFIX}${kind}-${[...random].map((part) => part.toString(36)).join("")}`;
}

export const isViewers = (name: string): boolean => name.startsWith(PREFIX);
