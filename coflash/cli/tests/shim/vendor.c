/* Stands in for a vendor's library: PCANBasic with -DPCAN, CANlib with -DCANLIB. Its one bus is the Unix socket that
 * FAKE_BUS names, on which frames go as the 16 bytes of struct can_frame. FAKE_LIE makes it lie. -DOLD leaves a function out. */
#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

static int bus = -1;

static int lies(const char *how)
{
    const char *lie = getenv("FAKE_LIE");
    return lie && strcmp(lie, how) == 0;
}

static int bus_open(void)
{
    const char *path = getenv("FAKE_BUS");
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    if (lies("hang"))
        for (;;)
            pause();
    if (!path)
        return 0;
    strncpy(address.sun_path, path, sizeof address.sun_path - 1);
    bus = socket(AF_UNIX, SOCK_STREAM, 0);
    return connect(bus, (struct sockaddr *)&address, sizeof address);
}

static void bus_write(uint32_t id, uint8_t len, const void *data)
{
    unsigned char frame[16] = { 0 };
    memcpy(frame, &id, 4);
    frame[4] = len;
    memcpy(frame + 8, data, len);
    if (bus >= 0 && send(bus, frame, sizeof frame, MSG_NOSIGNAL) < 0)
        return;
}

/* 1 where there was a frame. */
static int bus_read(uint32_t *id, uint8_t *len, void *data)
{
    unsigned char frame[16];
    if (bus < 0 || recv(bus, frame, 16, MSG_PEEK | MSG_DONTWAIT) < 16)
        return 0;
    if (recv(bus, frame, 16, 0) != 16)
        return 0;
    memcpy(id, frame, 4);
    *len = frame[4];
    memcpy(data, frame + 8, 8);
    return 1;
}

#ifdef PCAN
struct message { uint32_t id; uint8_t type, len, data[8]; };

uint32_t CAN_Initialize(uint16_t channel, uint16_t btr, uint8_t type, uint32_t port, uint16_t interrupt)
{
    if (lies("in use"))
        return 0x400;
    if (lies("garbage"))
        return 0xFFFFFFFF;
    /* PCAN_USBBUS1, PCAN_BAUD_500K. */
    if (channel != 0x51)
        return 0x1400;
    if (btr != 0x001C || type || port || interrupt)
        return 0x8000;
    return bus_open() ? 0x200 : 0;
}

uint32_t CAN_Uninitialize(uint16_t channel)
{
    close(bus);
    return 0;
}

#ifndef OLD
uint32_t CAN_GetStatus(uint16_t channel)
{
    if (lies("bus-off"))
        return 0x10;
    if (lies("passive"))
        return 0x40000;
    return lies("garbage status") ? 0xFFFFFFFF : 0;
}
#endif

uint32_t CAN_Read(uint16_t channel, struct message *message, void *time)
{
    static int errors;
    memset(message, 0, sizeof *message);
    if (lies("length")) {
        message->id = 0x585;
        message->len = 200;
        return 0;
    }
    if (lies("flood")) {
        message->id = 0x7FF;
        message->len = 8;
        return 0;
    }
    if (lies("lost"))
        return 0x1400;
    if ((lies("no acknowledge") || lies("disturbed")) && errors < 50) {
        errors++;
        /* Other at the acknowledge slot; stuff error in the data field. */
        message->type = 0x40;
        message->id = lies("disturbed") ? 4 : 8;
        message->data[1] = lies("disturbed") ? 10 : 25;
        message->data[3] = 128;
        message->len = 4;
        return 0;
    }
    /* PCAN_ERROR_QOVERRUN. */
    if (lies("overrun") && errors++ == 0)
        return 0x60;
    return bus_read(&message->id, &message->len, message->data) ? 0 : 0x20;
}

uint32_t CAN_Write(uint16_t channel, struct message *message)
{
    if (lies("full"))
        return 0x80;
    bus_write(message->id, message->len, message->data);
    return 0;
}

uint32_t CAN_GetValue(uint16_t channel, uint8_t parameter, void *value, uint32_t len)
{
    if (parameter == 0x0D && len == 4) {
        uint32_t condition = channel == 0x51 || (channel == 0x52 && lies("two")) ? 1 : 0;
        if (lies("garbage"))
            condition = 0xFFFFFFFF;
        memcpy(value, &condition, 4);
        return 0;
    }
    if (parameter == 0x0E) {
        /* With something that a terminal would obey, and no end where it lies. */
        if (lies("no end"))
            memset(value, 'x', len);
        else
            snprintf(value, len, "PCAN-USB\033[2J");
        return 0;
    }
    return 0x4000;
}

uint32_t CAN_SetValue(uint16_t channel, uint8_t parameter, void *value, uint32_t len)
{
    return 0x4000;
}
#endif

#ifdef CANLIB
void canInitializeLibrary(void)
{
}

int canGetNumberOfChannels(int *count)
{
    *count = lies("channels") ? 2000000000 : lies("negative") ? -5 : 2;
    return 0;
}

int canGetChannelData(int channel, int item, void *value, size_t len)
{
    snprintf(value, len, channel ? "Kvaser Virtual CAN Driver" : "Kvaser Leaf Light v2");
    return item == 26 ? 0 : -1;
}

int canOpenChannel(int channel, int flags)
{
    if (lies("in use"))
        return -31;
    return channel == 0 && flags == 0x20 ? (bus_open() ? -15 : 7) : -3;
}

int canClose(int handle)
{
    close(bus);
    return 0;
}

int canSetBusParams(int handle, long rate, unsigned before, unsigned behind, unsigned jump, unsigned samples, unsigned sync)
{
    /* canBITRATE_500K. */
    return handle == 7 && rate == -2 && !before && !behind && !jump && !samples && !sync ? 0 : -1;
}

int canBusOn(int handle)
{
    return handle == 7 ? 0 : -10;
}

int canBusOff(int handle)
{
    return 0;
}

int canWrite(int handle, long id, void *data, unsigned len, unsigned flags)
{
    if (lies("full"))
        return -13;
    if (handle != 7 || flags != 2)
        return -1;
    bus_write(id, len, data);
    return 0;
}

int canReadWait(int handle, long *id, void *data, unsigned *len, unsigned *flags, unsigned long *time, unsigned long wait)
{
    static int overruns;
    uint32_t number;
    uint8_t bytes;
    *flags = 2;
    if (lies("length")) {
        *id = 0x585;
        *len = 4000000000u;
        return 0;
    }
    if (lies("lost"))
        return -15;
    if (lies("garbage status"))
        return -123456;
    if (!bus_read(&number, &bytes, data)) {
        usleep(wait * 1000);
        if (!bus_read(&number, &bytes, data))
            return -2;
    }
    *id = number;
    *len = bytes;
    /* canMSGERR_SW_OVERRUN. */
    if (lies("overrun") && overruns++ == 0)
        *flags |= 0x400;
    return 0;
}

#ifndef OLD
int canReadStatus(int handle, unsigned long *flags)
{
    *flags = lies("bus-off") ? 2 : lies("passive") ? 1 : 8;
    return 0;
}
#endif

int canReadErrorCounters(int handle, unsigned *send, unsigned *receive, unsigned *overruns)
{
    *send = lies("passive") ? 128 : 0;
    *receive = 0;
    *overruns = 0;
    return 0;
}
#endif
