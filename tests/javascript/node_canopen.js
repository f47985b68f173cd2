// node-canopen (package `canopen`) as a CiA 302-3 master: a raw image into a device, by its own calls.
//
//   node node_canopen.js HOST:PORT NODE IMAGE
//
// The bus is a socketcand server; with an interface of Linux the package `socketcan` takes its place.
'use strict';

const fs = require('fs');
const net = require('net');
const { Device, DataType } = require('canopen');

const STOP = 0, START = 1, CLEAR = 3;
const RUNNING = 1;

/** A socketcand client with what node-canopen wants of a channel. */
function connect(address, onMessage) {
    const [host, port] = address.split(':');
    const socket = net.connect({ host, port: Number(port), noDelay: true });
    let text = '';
    return new Promise((resolve, reject) => {
        socket.on('error', reject);
        socket.on('data', (data) => {
            text += data;
            for (let end; (end = text.indexOf('>')) >= 0; text = text.slice(end + 1)) {
                const words = text.slice(0, end).replace('<', '').trim().split(/ +/);
                if (words[0] === 'hi') socket.write('< open can0 >< rawmode >');
                if (words[0] === 'ok') resolve({ send, end: () => socket.destroy() });
                if (words[0] === 'frame') {
                    onMessage({ id: parseInt(words[1], 16), data: Buffer.from(words.slice(3).join(''), 'hex') });
                }
            }
        });
        function send({ id, data }) {
            const bytes = [...data].map((byte) => byte.toString(16).padStart(2, '0')).join(' ');
            socket.write(`< send ${id.toString(16)} ${data.length} ${bytes} >`);
        }
    });
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

async function main(address, node, file) {
    const image = fs.readFileSync(file);
    const master = new Device({ id: 127 });
    const channel = await connect(address, (message) => master.receive(message));
    master.addListener('message', (message) => channel.send(message));
    master.eds.addSdoClientParameter(node, 0x600 | node, 0x580 | node);
    master.start();

    // Its default time-out is 30 ms, which is short of what a restart takes.
    const one = { deviceId: node, subIndex: 1, timeout: 1000 };
    const control = () => master.sdo.upload({ ...one, index: 0x1F51, dataType: DataType.UNSIGNED8 });
    const command = (data) =>
        master.sdo.download({ ...one, index: 0x1F51, data, dataType: DataType.UNSIGNED8 });
    const status = () => master.sdo.upload({ ...one, index: 0x1F57, dataType: DataType.UNSIGNED32 });
    const until = async (done) => {
        for (let i = 0; i < 100; ++i) {
            try {
                if (await done()) return;
            } catch (error) {
                // A device that restarts does not answer.
            }
            await pause(100);
        }
        throw new Error('the device does not come to it');
    };

    if (await control() === RUNNING) {
        await command(STOP);
        await until(async () => await control() !== RUNNING);
        console.log('stopped');
    }
    await command(CLEAR);
    await until(async () => !(await status() & 1));
    console.log('cleared');
    await master.sdo.download({ ...one, index: 0x1F50, data: image, dataType: DataType.DOMAIN, blockTransfer: true });
    await until(async () => !(await status() & 1));
    const flash = await status();
    if (flash !== 0) throw new Error(`1F57h reads ${flash.toString(16)}h`);
    console.log(`${image.length} bytes sent`);
    await command(START);
    await until(async () => await control() === RUNNING);
    const crc = await master.sdo.upload({ ...one, index: 0x1F56, dataType: DataType.UNSIGNED32 });
    console.log(`started, 1F56h = ${crc.toString(16).toUpperCase().padStart(8, '0')}h`);
    master.stop();
    channel.end();
}

main(process.argv[2], Number(process.argv[3]), process.argv[4]).catch((error) => {
    console.error(`failed: ${error}`);
    process.exit(1);
});
