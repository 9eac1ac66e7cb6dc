/** What the window shows. */
export interface Page {
  readonly element: HTMLElement;
  /** Ends what the page has begun: sessions, listeners. */
  end(): void | Promise<void>;
}
