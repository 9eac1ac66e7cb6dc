// HTTP requests to the server that this page came from, and the token for it.

import { PROTOCOL } from "./protocol";

/** What the server answered instead. */
export class Refused extends Error {
  readonly code: string;
  readonly field: string | undefined;

  constructor(refusal: { code?: string; message?: string; field?: string }) {
    super(refusal.message ?? "the server refused the request");
    this.code = refusal.code ?? "internal";
    this.field = refusal.field;
  }
}

const TOKEN = "wildcity-token";

/** Remembers the token until the tab is closed. */
export function useToken(token: string): void {
  sessionStorage.setItem(TOKEN, token);
}

const token = (): string | null => sessionStorage.getItem(TOKEN);

interface Sent {
  body?: BodyInit;
  headers?: Record<string, string>;
}

async function request(method: string, path: string, { body, headers: own }: Sent = {}): Promise<Response> {
  const headers: Record<string, string> = { ...own };
  const bearer = token();
  if (bearer) headers.authorization = `Bearer ${bearer}`;
  const response = await fetch(path, { method, headers, ...(body !== undefined && { body }) });
  if (response.ok) return response;
  throw new Refused(await response.json().catch(() => ({ message: `HTTP ${response.status}` })));
}

export async function get<T>(path: string): Promise<T> {
  return (await request("GET", path)).json();
}

export async function getText(path: string): Promise<string> {
  return (await request("GET", path)).text();
}

/** Sends JSON. */
export async function post<T>(path: string, value: unknown): Promise<T> {
  return (await request("POST", path, { body: JSON.stringify(value) })).json();
}

/** Appends a part of a file to its upload. */
export async function append(path: string, part: Blob, offset: number): Promise<void> {
  await request("PATCH", path, { body: part, headers: { "upload-offset": String(offset) } });
}

/** Opens a WebSocket. Browsers cannot send a token with it: on a server with tokens a ticket stands for it. */
export async function socket(path: string, protocol = PROTOCOL): Promise<WebSocket> {
  const url = new URL(path, location.href);
  url.protocol = url.protocol.replace("http", "ws");
  url.hash = "";
  if (token()) {
    const { ticket } = await (await request("POST", "v1/tickets")).json();
    url.searchParams.set("ticket", ticket);
  }
  const socket = new WebSocket(url, protocol);
  socket.binaryType = "arraybuffer";
  return new Promise((resolve, reject) => {
    socket.onopen = () => resolve(socket);
    socket.onerror = () => reject(new Error("the server refused the WebSocket, or is gone"));
  });
}
