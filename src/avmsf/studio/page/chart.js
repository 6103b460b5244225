/** A small diagram: axes and curves on a canvas that is as sharp as the screen, in the page's own colors. */

const MARGIN = { left: 34, right: 8, top: 8, bottom: 20 };

export class Chart {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
  }

  begin() {
    const { canvas, context } = this;
    [this.width, this.height] = [canvas.clientWidth, canvas.clientHeight];
    // This clears the canvas, too.
    [canvas.width, canvas.height] = [this.width, this.height].map((size) => Math.round(size * devicePixelRatio));
    context.scale(devicePixelRatio, devicePixelRatio);
    const style = getComputedStyle(canvas);
    this.ink = Object.fromEntries(
      ["faint", "line", "first", "second"].map((name) => [name, style.getPropertyValue(`--${name}`).trim()]),
    );
    context.font = `11px ${style.fontFamily}`;
    context.lineWidth = 1;
  }

  x(share) {
    return MARGIN.left + share * (this.width - MARGIN.left - MARGIN.right);
  }

  y(share) {
    return MARGIN.top + share * (this.height - MARGIN.top - MARGIN.bottom);
  }

  axes(across, down) {
    const { context, ink } = this;
    context.strokeStyle = ink.line;
    context.fillStyle = ink.faint;
    context.beginPath();
    for (const { share, words } of down) {
      const y = Math.round(this.y(share)) + 0.5;
      context.moveTo(this.x(0), y);
      context.lineTo(this.x(1), y);
      context.textAlign = "right";
      context.textBaseline = "middle";
      context.fillText(words, this.x(0) - 5, y);
    }
    for (const { share, words } of across) {
      const x = Math.round(this.x(share)) + 0.5;
      context.moveTo(x, this.y(0));
      context.lineTo(x, this.y(1));
      context.textAlign = share > 0.9 ? "right" : "center";
      context.textBaseline = "bottom";
      context.fillText(words, share > 0.9 ? this.x(1) : x, this.height - 3);
    }
    context.stroke();
  }

  curve(shares, color, { width = 1.5, dash = [], fill = false } = {}) {
    const { context } = this;
    context.save();
    context.beginPath();
    context.rect(this.x(0), this.y(0), this.x(1) - this.x(0), this.y(1) - this.y(0));
    context.clip();
    context.beginPath();
    shares.forEach(([across, down], place) => {
      const [x, y] = [this.x(across), this.y(Math.min(Math.max(down, -0.1), 1.1))];
      if (place) context.lineTo(x, y);
      else context.moveTo(x, y);
    });
    context.strokeStyle = color;
    context.lineWidth = width;
    context.setLineDash(dash);
    context.stroke();
    if (fill) {
      context.lineTo(this.x(shares.at(-1)[0]), this.y(1));
      context.lineTo(this.x(shares[0][0]), this.y(1));
      context.globalAlpha = 0.16;
      context.fillStyle = color;
      context.fill();
    }
    context.restore();
  }
}
