// Browsers allow no web workers on pages opened from files: the search runs in a hidden frame with the same interface.
if (location.protocol === 'file:') window.Worker = class extends EventTarget {
  constructor(url) {
    super()
    this.frame = document.createElement('iframe')
    this.frame.hidden = true
    document.body.append(this.frame)
    const inner = this.frame.contentWindow
    const load = (address) => new Promise((done) => {
      const script = inner.document.createElement('script')
      script.src = address
      script.onload = done
      inner.document.body.append(script)
    })
    inner.document.open()
    inner.document.write('<body></body>')
    inner.document.close()
    inner.postMessage = (data) => this.dispatchEvent(new MessageEvent('message', {data}))
    inner.importScripts = (...addresses) => addresses.reduce((before, address) => before.then(() => load(address)), Promise.resolve())
    this.loaded = load(url)
  }
  postMessage(data) {
    const inner = this.frame.contentWindow
    this.loaded.then(() => inner.dispatchEvent(new inner.MessageEvent('message', {data})))
  }
  terminate() {
    this.frame.remove()
  }
}
