// What the driver wants: keys, gamepad, or the pads on a touch screen.

import { el } from "./dom";
import { clamp } from "./pose";

/** What the driver asks for: acceleration from -1 (brake) to 1, and steering from -1 to 1, positive to the left. */
export interface DriveInput {
  throttle: number;
  steer: number;
  /** Brake to a stop, whatever else is pressed. */
  stop: boolean;
}

/** Full steering from keys takes this long, in seconds. */
const STEER_S = 0.45;
const DEAD_ZONE = 0.12;

const KEYS: Record<string, string> = {
  KeyW: "up", ArrowUp: "up", KeyS: "down", ArrowDown: "down",
  KeyA: "left", ArrowLeft: "left", KeyD: "right", ArrowRight: "right", Space: "stop",
};

export class Controls {
  /** Pads for a touch screen. */
  readonly pads: HTMLElement;
  private readonly pressed = new Set<string>();
  private steer = 0;
  private asked = performance.now();
  private readonly abort = new AbortController();

  /** `onKey` gets every other key that is pressed. */
  constructor(onKey: (code: string) => void) {
    const { signal } = this.abort;
    addEventListener("keydown", (event) => {
      if (hasModifier(event) || isField(event.target)) return;
      const direction = KEYS[event.code];
      if (direction) {
        this.pressed.add(direction);
        event.preventDefault();
      } else if (!event.repeat) onKey(event.code);
    }, { signal });
    addEventListener("keyup", (event) => this.pressed.delete(KEYS[event.code] ?? ""), { signal });
    addEventListener("blur", () => this.pressed.clear(), { signal });
    const pad = (direction: string, text: string): HTMLElement => {
      const button = el("button.pad", { type: "button", ariaLabel: direction }, text);
      button.addEventListener("pointerdown", (event) => {
        event.preventDefault();
        this.pressed.add(direction);
      });
      for (const kind of ["pointerup", "pointercancel", "pointerleave"]) {
        button.addEventListener(kind, () => this.pressed.delete(direction));
      }
      return button;
    };
    this.pads = el("div.pads", {}, pad("left", "◀"), pad("right", "▶"), pad("down", "▼"), pad("up", "▲"));
  }

  /** The input now. Keys steer at a limited speed. */
  read(): DriveInput {
    const now = performance.now();
    const seconds = Math.min(0.5, (now - this.asked) / 1000);
    this.asked = now;
    const axis = (plus: string, minus: string): number => Number(this.pressed.has(plus)) - Number(this.pressed.has(minus));
    const step = seconds / STEER_S;
    this.steer += clamp(axis("left", "right") - this.steer, -step, step);
    const input = { throttle: axis("up", "down"), steer: this.steer, stop: this.pressed.has("stop") };
    const pad = navigator.getGamepads?.().find((gamepad) => gamepad?.connected && gamepad.mapping === "standard");
    if (pad) {
      const turn = -(pad.axes[0] ?? 0);
      const drive = (pad.buttons[7]?.value ?? 0) - (pad.buttons[6]?.value ?? 0);
      // The trigger's middle is fine steering: the square of its way.
      if (Math.abs(turn) > DEAD_ZONE) input.steer = turn * Math.abs(turn);
      if (Math.abs(drive) > DEAD_ZONE) input.throttle = drive;
      if (pad.buttons[0]?.pressed) input.stop = true;
    }
    return input;
  }

  end(): void {
    this.abort.abort();
  }
}

/** Keys with these are for the browser: Alt and left goes back. */
export const hasModifier = ({ altKey, ctrlKey, metaKey }: KeyboardEvent): boolean => altKey || ctrlKey || metaKey;

function isField(target: EventTarget | null): boolean {
  return target instanceof HTMLInputElement || target instanceof HTMLSelectElement;
}
