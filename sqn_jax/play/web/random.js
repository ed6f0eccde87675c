/**
 * Random numbers from a seed: the same seed gives the same numbers in every browser.
 */
export class Random {
  /** @param {number} seed a whole number; its lowest 32 bits count. */
  constructor(seed) {
    this.state = seed >>> 0;
  }

  /** @returns {number} a whole number from 0 to 2^32 - 1. */
  bits() {
    // A counter in steps of the golden ratio, each number scrambled by shifts and products.
    this.state = (this.state + 0x9e3779b9) >>> 0;
    let word = this.state;
    word = Math.imul(word ^ (word >>> 16), 0x85ebca6b);
    word = Math.imul(word ^ (word >>> 13), 0xc2b2ae35);
    return (word ^ (word >>> 16)) >>> 0;
  }

  /** @returns {number} at least 0 and less than 1. */
  uniform() {
    return this.bits() / 2 ** 32;
  }

  /**
   * @param {number} low
   * @param {number} high
   * @returns {number} at least `low` and less than `high`.
   */
  between(low, high) {
    return low + (high - low) * this.uniform();
  }

  /**
   * @param {number} count
   * @returns {number} a whole number from 0 to `count` - 1.
   */
  integer(count) {
    return Math.floor(this.uniform() * count);
  }

  /** @returns {number} normally distributed, of mean 0 and standard deviation 1 (Box and Muller). */
  normal() {
    const radius = Math.sqrt(-2 * Math.log(1 - this.uniform()));
    return radius * Math.cos(2 * Math.PI * this.uniform());
  }

  /**
   * @template T
   * @param {T[]} items are put into a random order, in place.
   * @returns {T[]} the same array.
   */
  shuffle(items) {
    for (let last = items.length - 1; last > 0; last -= 1) {
      const other = this.integer(last + 1);
      [items[last], items[other]] = [items[other], items[last]];
    }
    return items;
  }
}
