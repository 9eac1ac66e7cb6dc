// Names of the sessions that only look. Their records are no drives, and the first page leaves them out.

const PREFIX = "viewer-";

export const viewerSession = (kind: string): string => `${PREFIX}${kind}-${random()}`;

/** A drive by hand: its name is what people look for among the recorded episodes. */
export const drivenSession = (twin: string): string => `${twin.slice(0, 40)}-by-hand-${random()}`;

const random = (): string => crypto.getRandomValues(new Uint32Array(1))[0]!.toString(36);

export const isViewers = (name: string): boolean => name.startsWith(PREFIX);
