// One session over the WebSocket, in lock step: a request, then its answer.

import { Observation, PROTOCOL, ProtocolError, parseObservation } from "./protocol";
import type { Closed, Opened, Welcome } from "./messages";
import { Refused, socket } from "./server";

type Fields = Record<string, unknown>;

/** How often a lost connection is tried again, and how long to wait before the n-th attempt. */
const ATTEMPTS = 6;
const waitMs = (attempt: number): number => 250 * 2 ** attempt;

export class Client {
  /** Set by `connect`. */
  welcome!: Welcome;
  /** Called when the connection is lost (true) and when it is back (false). */
  onLost: (lost: boolean) => void = () => {};

  private socket: WebSocket | undefined;
  private session: string | undefined;
  /** Number of the next request. */
  private seq = 0;
  private waiting: ((message: MessageEvent | undefined) => void) | undefined;
  /** Requests are sent one after the other. */
  private last: Promise<unknown> = Promise.resolve();
  private ended = false;

  /** Connects, unless that is done. Separate from the constructor, so that `end` ends a connection that is only being made. */
  connect(): Promise<void> {
    return this.queue(async () => {
      if (!this.welcome) await this.dial();
    });
  }

  open(fields: Fields): Promise<Opened> {
    return this.queue(async () => {
      const opened = (await this.ask({ type: "open", ...fields })) as Opened;
      this.session = opened.session;
      return opened;
    });
  }

  /** Requests with an observation as the answer: reset, step, observe. */
  observation(fields: Fields): Promise<Observation> {
    return this.queue(async () => {
      const answer = await this.ask(fields);
      if (answer instanceof Observation) return answer;
      throw new ProtocolError(`${(answer as { type: string }).type} instead of an observation`);
    });
  }

  close(): Promise<Closed> {
    return this.queue(async () => {
      const closed = (await this.ask({ type: "close" })) as Closed;
      this.session = undefined;
      return closed;
    });
  }

  /** Closes the session, if there is one, and the connection. Requests after it fail. */
  async end(): Promise<void> {
    this.ended = true;
    // A request that is under way may be the one that opens the session.
    await this.last;
    // Two callers may end it; one of them closes the session.
    const { session } = this;
    this.session = undefined;
    if (session) await this.ask({ type: "close" }).catch(() => {});
    this.socket?.close(1000);
  }

  private queue<T>(run: () => Promise<T>): Promise<T> {
    const result = this.last.then(() => {
      if (this.ended) throw new Lost("the page was left");
      return run();
    });
    this.last = result.catch(() => {});
    return result;
  }

  private async dial(): Promise<void> {
    this.socket = await socket("v1/session");
    const lost = (): void => this.waiting?.(undefined);
    this.socket.onmessage = (message) => this.waiting?.(message);
    this.socket.onclose = lost;
    this.socket.onerror = lost;
    const client = { name: "viewer", version: "1" };
    this.welcome = (await this.exchange({ type: "hello", seq: 0, client, protocols: [PROTOCOL] })) as Welcome;
    this.seq = Math.max(this.seq, 1);
  }

  /** Sends a request; if the connection is lost meanwhile, resumes the session and sends it again. */
  private async ask(fields: Fields): Promise<unknown> {
    for (let attempt = 0; ; attempt++) {
      try {
        const answer = await this.exchange({ ...fields, seq: this.seq });
        this.seq++;
        return answer;
      } catch (error) {
        if (!(error instanceof Lost) || !this.session || this.ended || attempt >= ATTEMPTS) throw error;
        this.onLost(true);
        await new Promise((resolve) => setTimeout(resolve, waitMs(attempt)));
        try {
          await this.dial();
          await this.exchange({ type: "resume", seq: 1, session: this.session, last_seq: this.seq - 1 });
          this.onLost(false);
        } catch (again) {
          if (again instanceof Refused) throw again;
        }
      }
    }
  }

  private async exchange(message: Fields): Promise<unknown> {
    if (this.socket?.readyState !== WebSocket.OPEN) throw new Lost("the connection is lost");
    const answer = await new Promise<MessageEvent | undefined>((resolve) => {
      this.waiting = resolve;
      this.socket!.send(JSON.stringify(message));
    });
    this.waiting = undefined;
    if (!answer) throw new Lost("the connection is lost");
    if (answer.data instanceof ArrayBuffer) return parseObservation(answer.data);
    const parsed = JSON.parse(answer.data);
    if (parsed.type === "error") throw new Refused(parsed);
    return parsed;
  }
}

class Lost extends Error {}
