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

/** What a token may do: open sessions, upload and push, or everything. */
export type Role = "metrics" | "drive" | "push" | "admin";

/** Keys of what is remembered until the tab is closed. */
const TOKEN = "wildcity-token";
const ROLE = "wildcity-role";
/** Set once the server has asked for a token. */
const ASKED = "wildcity-asked-for-token";

const token = (): string | null => sessionStorage.getItem(TOKEN);

export function useToken(value: string): void {
  sessionStorage.setItem(TOKEN, value);
  sessionStorage.removeItem(ROLE);
}

/** Whether requests are known to fail until there is a token. */
export const lacksToken = (): boolean => !token() && sessionStorage.getItem(ASKED) !== null;

let unauthorized: (hadToken: boolean) => void = () => {};

/** `then` is called whenever the server asks for a token, or does not know the one it got. */
export function whenUnauthorized(then: (hadToken: boolean) => void): void {
  unauthorized = then;
}

/** The role of the token; undefined without a token. A server without tokens allows everything. */
export async function roleOfToken(): Promise<Role | undefined> {
  if (!token()) return undefined;
  const known = sessionStorage.getItem(ROLE);
  if (known) return known as Role;
  let role: Role = "admin";
  try {
    await get("v1/sessions");
  } catch (error) {
    if (!(error instanceof Refused && error.code === "forbidden" && error.field === "authorization")) throw error;
    // The refusal names the role of the token, and no answer of the server does.
    role = (/role is (metrics|drive|push)/.exec(error.message)?.[1] ?? "drive") as Role;
  }
  sessionStorage.setItem(ROLE, role);
  return role;
}

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
  if (response.status === 401) {
    sessionStorage.removeItem(TOKEN);
    sessionStorage.setItem(ASKED, "");
    unauthorized(bearer !== null);
  }
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
  const isOpen = await new Promise<boolean>((resolve) => {
    socket.onopen = () => resolve(true);
    socket.onerror = () => resolve(false);
  });
  if (isOpen) return socket;
  // Browsers do not say why a WebSocket was refused. Another request is refused for the same reason, and says it.
  await get("v1/twins");
  throw new Error("the server refused the WebSocket: the token's role or its limit of sessions does not allow it");
}
