// Asks for the token of a server that needs one.

import { el, showStatus, showTitle } from "./dom";
import type { Page } from "./page";
import { useToken } from "./server";

export class TokenPage implements Page {
  readonly element: HTMLElement;

  /** `then` is called when there is a token. `wasRefused` says that the server did not know the last one. */
  constructor(wasRefused: boolean, then: () => void) {
    const field = el("input", { type: "password", autocomplete: "off", placeholder: "token", ariaLabel: "token" });
    const form = el("form.token", {}, el("p", {}, "This server needs a token. It is kept until this tab is closed."),
      field, el("button", { type: "submit" }, "Continue"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const value = field.value.trim();
      if (!value) return;
      useToken(value);
      then();
    });
    showTitle();
    showStatus(wasRefused ? "the server does not know this token" : "", "bad");
    this.element = el("div.home", {}, form);
    // Once it is in the page.
    queueMicrotask(() => field.focus());
  }

  end(): void {}
}
