// What the driver wants: keys, gamepad, or the pads on a touch screen.

import { el } from "./dom";
import { clamp } from "./pose";

/** Acceleration from -1 (brake) to 1, and steering from -1 to 1, positive to the left. */
export interface Wish {
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
      if (event.ctrlKey || event.metaKey || event.altKey || isField(event.target)) return;
      const wish = KEYS[event.code];
      if (wish) {
        this.pressed.add(wish);
        event.preventDefault();
      } else if (!event.repeat) onKey(event.code);
    }, { signal });
    addEventListener("keyup", (event) => this.pressed.delete(KEYS[event.code] ?? ""), { signal });
    addEventListener("blur", () => this.pressed.clear(), { signal });
    const pad = (wish: string, text: string): HTMLElement => {
      const button = el("button.pad", { type: "button", ariaLabel: wish }, text);
      button.classList.add(wish);
      button.addEventListener("pointerdown", (event) => {
        event.preventDefault();
        this.pressed.add(wish);
      });
      for (const kind of ["pointerup", "pointercancel", "pointerleave"]) {
        button.addEventListener(kind, () => this.pressed.delete(wish));
      }
      return button;
    };
    this.pads = el("div.pads", {}, pad("left", "◀"), pad("right", "▶"), pad("down", "▼"), pad("up", "▲"));
  }

  /** The wish now. Keys steer at a limited speed. */
  wish(): Wish {
    const now = performance.now();
    const seconds = Math.min(0.5, (now - this.asked) / 1000);
    this.asked = now;
    const axis = (plus: string, minus: string): number => Number(this.pressed.has(plus)) - Number(this.pressed.has(minus));
    const step = seconds / STEER_S;
    this.steer += clamp(axis("left", "right") - this.steer, -step, step);
    const wish = { throttle: axis("up", "down"), steer: this.steer, stop: this.pressed.has("stop") };
    const pad = navigator.getGamepads?.().find((gamepad) => gamepad?.connected && gamepad.mapping === "standard");
    if (pad) {
      const turn = -(pad.axes[0] ?? 0);
      const drive = (pad.buttons[7]?.value ?? 0) - (pad.buttons[6]?.value ?? 0);
      // The trigger's middle is fine steering: the square of its way.
      if (Math.abs(turn) > DEAD_ZONE) wish.steer = turn * Math.abs(turn);
      if (Math.abs(drive) > DEAD_ZONE) wish.throttle = drive;
      if (pad.buttons[0]?.pressed) wish.stop = true;
    }
    return wish;
  }

  end(): void {
    this.abort.abort();
  }
}

function isField(target: EventTarget | null): boolean {
  return target instanceof HTMLInputElement || target instanceof HTMLSelectElement;
}
